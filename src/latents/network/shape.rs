//! The extents of a model, as its file's metadata states them.

use serde::{Deserialize, Serialize};

use super::head::Head;
use super::structure::ROLES;
use crate::error::{Error, Result, Stage};
use crate::gaussians::Heads;

/// Everything that a model file says of the network beside its tensors. Other keys of the file are ignored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// Version of the model file's layout; 1.
    pub format: u32,
    /// What the model is called.
    #[serde(default)]
    pub name: String,
    /// C: channels of a feature, a multiple of 4.
    pub channels: usize,
    /// K: latents per voxel.
    pub latents: usize,
    /// How many roles have latents, the first ones: what is known of the levels of others comes from the level below
    /// alone.
    #[serde(default = "all_roles")]
    pub latent_roles: usize,
    /// Whether what predicts from neighbours learns from what is coded: see [`crate::latents::entropy`].
    #[serde(default)]
    pub learning: bool,
    /// Channels of the network that predicts the base level from neighbours, a multiple of 4; 0 where there is none.
    #[serde(default)]
    pub base_channels: usize,
    /// The same of the networks that do so above it, for roles 1 and 2.
    #[serde(default)]
    pub near_channels: [usize; 2],
    /// Inception blocks of each feature conversion (FC).
    pub fc_blocks: usize,
    /// Inception blocks of each predictive entropy model (PEM).
    pub pem_blocks: usize,
    /// Inception blocks of each feature reconstruction (FR).
    pub fr_blocks: usize,
    /// How many roles have one: at least those that have latents. The features of others are what the level below
    /// tells.
    #[serde(default = "all_roles")]
    pub fr_roles: usize,
    /// The Gaussian generators (GG): one for each role that has Gaussians, and if there are quick ones, another for
    /// each of these.
    pub gg: Vec<Head>,
    /// How a feature gets to the children.
    pub upsample: Upsample,
    /// Whether an Inception block ends in a ReLU.
    pub inception_relu: bool,
    /// Whether a residual block ends in a ReLU.
    pub resblock_relu: bool,
    /// Latents lie in ±latent_max.
    pub latent_max: i16,
    /// Latents enter the integer network shifted left by this.
    pub latent_shift: u8,
    /// Reach of a Gaussian's centre from its voxel's, in voxels.
    pub offset_range: f32,
    /// Standard deviation, in voxels, per unit of softplus.
    pub scale_range: f32,
    /// Added to the raw scale before softplus.
    pub scale_bias: f32,
    /// Added to the raw opacity before the sigmoid.
    pub opacity_bias: f32,
    /// Variance that pictures widen the Gaussians by, in squared voxels ([`crate::gaussians::Gaussians::blur`]): about
    /// what they were trained with.
    #[serde(default = "first_blur")]
    pub blur: f32,
    /// The weight of distortion against rate that the model was trained with.
    #[serde(default, rename = "lambda", skip_serializing_if = "Option::is_none")]
    pub lambda: Option<f64>,
}

/// How a feature gets to the children.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Upsample {
    /// Each child copies its parent's.
    Nearest,
    /// A linear layer per octant.
    Learned,
}

/// Of models whose descriptions do not say.
fn first_blur() -> f32 {
    0.075
}

fn all_roles() -> usize {
    ROLES
}

/// Channels beyond which no model is taken.
const MAX_CHANNELS: usize = 256;
/// Latents beyond which no model is taken.
const MAX_LATENTS: usize = 64;
/// Blocks in a row beyond which no model is taken.
const MAX_BLOCKS: usize = 16;

impl Shape {
    /// The smallest network that has every layer, for tests.
    pub fn tiny() -> Self {
        let head = |role, children| Head {
            role,
            channels: 8,
            blocks_before: 1,
            blocks_after: 1,
            children,
            heads: Heads::Best,
        };
        Shape {
            format: 1,
            name: "tiny".into(),
            channels: 8,
            latents: 4,
            latent_roles: ROLES,
            learning: false,
            base_channels: 8,
            near_channels: [8, 4],
            fc_blocks: 1,
            pem_blocks: 1,
            fr_blocks: 1,
            fr_roles: ROLES,
            gg: vec![head(1, 8), head(2, 1)],
            upsample: Upsample::Learned,
            inception_relu: true,
            resblock_relu: true,
            latent_max: 31,
            latent_shift: 6,
            offset_range: 1.0,
            scale_range: 1.0,
            scale_bias: -0.31,
            opacity_bias: 2.0,
            blur: first_blur(),
            lambda: None,
        }
    }

    /// The same with quick heads as well: those it has, of 4 channels and without blocks before the fourth layer.
    pub fn with_quick_heads(mut self) -> Self {
        let quick: Vec<Head> = self
            .gg
            .iter()
            .map(|head| Head {
                channels: 4,
                blocks_before: 0,
                heads: Heads::Quick,
                ..head.clone()
            })
            .collect();
        self.gg.extend(quick);
        self
    }

    /// Reads the metadata's JSON.
    ///
    /// # Errors
    /// [`Error::Malformed`] if a field is missing or out of range, [`Error::Unsupported`] for another format.
    pub fn from_json(json: &str) -> Result<Self> {
        let shape: Shape = serde_json::from_str(json)
            .map_err(|error| Error::malformed(Stage::Network, "metadata", "b2p", error, "a model's description"))?;
        if shape.format != 1 {
            return Err(Error::Unsupported {
                what: "the model file's format",
                detail: format!("it is {}, this program reads 1", shape.format),
            });
        }
        shape.check()?;
        Ok(shape)
    }

    /// The metadata's JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a shape has no keys but strings")
    }

    /// Latents per voxel of a role: K, or 0 if it has none.
    pub fn latents_of(&self, role: usize) -> usize {
        if role < self.latent_roles { self.latents } else { 0 }
    }

    /// The head of a role.
    pub fn head(&self, role: usize, heads: Heads) -> Option<&Head> {
        let wanted = |head: &&Head| (head.role, head.heads) == (role, heads);
        self.gg.iter().find(wanted)
    }

    /// The sets of heads that there are, the default first.
    pub fn heads(&self) -> Vec<Heads> {
        let has = |heads: &Heads| self.gg.iter().any(|head| head.heads == *heads);
        Heads::ALL.into_iter().filter(has).collect()
    }

    /// What of the shape bears on the decoded bits, in a form that is hashed.
    pub(super) fn exact_text(&self) -> String {
        let upsample = match self.upsample {
            Upsample::Nearest => "nearest",
            Upsample::Learned => "learned",
        };
        let base = match self.base_channels {
            0 => String::new(),
            channels => format!(";base_channels={channels}"),
        };
        let near = match self.near_channels {
            [0, 0] => String::new(),
            [first, second] => format!(";near_channels={first},{second}"),
        };
        let roles = match self.latent_roles {
            ROLES => String::new(),
            roles => format!(";latent_roles={roles}"),
        };
        let reconstructed = match self.fr_roles {
            ROLES => String::new(),
            roles => format!(";fr_roles={roles}"),
        };
        let learning = if self.learning { ";learning=2" } else { "" };
        format!(
            "channels={};latents={};pem_blocks={};fr_blocks={};upsample={upsample};inception_relu={};latent_max={};latent_shift={}{base}{near}{roles}{reconstructed}{learning}",
            self.channels,
            self.latents,
            self.pem_blocks,
            self.fr_blocks,
            self.inception_relu,
            self.latent_max,
            self.latent_shift,
        )
    }

    fn check(&self) -> Result<()> {
        require(
            are_channels(self.channels),
            "channels",
            &self.channels,
            "a multiple of 4 up to 256",
        )?;
        require(
            self.base_channels == 0 || are_channels(self.base_channels),
            "base_channels",
            &self.base_channels,
            "0, or a multiple of 4 up to 256",
        )?;
        let latents = (1..=MAX_LATENTS).contains(&self.latents);
        require(latents, "latents", &self.latents, "1 to 64")?;
        let roles = (1..=ROLES).contains(&self.latent_roles);
        require(roles, "latent_roles", &self.latent_roles, "1 to 3")?;
        let roles = (self.latent_roles..=ROLES).contains(&self.fr_roles);
        require(roles, "fr_roles", &self.fr_roles, "latent_roles to 3")?;
        for (role, near) in (1..).zip(self.near_channels) {
            require(
                near == 0 || (are_channels(near) && role < self.latent_roles),
                "near_channels",
                &near,
                "0, or for a role that has latents a multiple of 4 up to 256",
            )?;
        }
        for (field, blocks) in [
            ("fc_blocks", self.fc_blocks),
            ("pem_blocks", self.pem_blocks),
            ("fr_blocks", self.fr_blocks),
        ] {
            require(blocks <= MAX_BLOCKS, field, &blocks, "at most 16")?;
        }
        require(self.latent_max > 0, "latent_max", &self.latent_max, "at least 1")?;
        let reach = i64::from(self.latent_max) << self.latent_shift.min(16);
        require(reach <= 2047, "latent_max << latent_shift", &reach, "at most 2047")?;
        let ranges = [
            ("offset_range", self.offset_range, 0.0, 64.0, "0 to 64"),
            ("scale_range", self.scale_range, 1e-3, 64.0, "0.001 to 64"),
            ("scale_bias", self.scale_bias, -64.0, 64.0, "−64 to 64"),
            ("opacity_bias", self.opacity_bias, -64.0, 64.0, "−64 to 64"),
            ("blur", self.blur, 0.0, 1.0, "0 to 1"),
        ];
        for (field, value, low, high, expected) in ranges {
            require((low..=high).contains(&value), field, &value, expected)?;
        }
        self.check_heads()
    }

    fn check_heads(&self) -> Result<()> {
        for (i, head) in self.gg.iter().enumerate() {
            let field = |name: &str| format!("gg[{i}].{name}");
            let before = |heads| {
                let mut before = self.gg[..i].iter();
                before.any(|other| (other.role, other.heads) == (head.role, heads))
            };
            require(
                !before(head.heads) && matches!(head.role, 1 | 2),
                &field("role"),
                &head.role,
                "1 or 2, each once",
            )?;
            require(
                head.heads == Heads::Best || before(Heads::Best),
                &field("heads"),
                &head.heads,
                "quick for a role that has its best before it",
            )?;
            let children = if head.role == 1 { 8 } else { 1 };
            require(
                head.children == children,
                &field("children"),
                &head.children,
                "8 for role 1, 1 for role 2",
            )?;
            require(
                are_channels(head.channels),
                &field("channels"),
                &head.channels,
                "a multiple of 4 up to 256",
            )?;
            let blocks = head.blocks_before.max(head.blocks_after);
            require(blocks <= MAX_BLOCKS, &field("blocks"), &blocks, "at most 16")?;
        }
        let of = |heads| self.gg.iter().filter(move |head| head.heads == heads).count();
        let quick = of(Heads::Quick);
        require(
            quick == 0 || quick == of(Heads::Best),
            "gg",
            &format!("{quick} quick heads"),
            "none, or one for each role that has Gaussians",
        )
    }
}

/// Fails with [`Error::Malformed`] unless `ok`.
fn require(ok: bool, field: &str, value: &dyn ToString, expected: &str) -> Result<()> {
    match ok {
        true => Ok(()),
        false => Err(Error::malformed(
            Stage::Network,
            "metadata",
            field,
            value.to_string(),
            expected,
        )),
    }
}

fn are_channels(n: usize) -> bool {
    n > 0 && n <= MAX_CHANNELS && n.is_multiple_of(4)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn altered(field: &str, value: &str) -> Result<Shape> {
        altered_from(Shape::tiny(), field, value)
    }

    fn altered_from(shape: Shape, field: &str, value: &str) -> Result<Shape> {
        let mut json: serde_json::Value = serde_json::from_str(&shape.to_json()).unwrap();
        *json.pointer_mut(field).unwrap() = serde_json::from_str(value).unwrap();
        Shape::from_json(&json.to_string())
    }

    #[test]
    fn a_shape_survives_its_own_text() {
        assert_eq!(Shape::from_json(&Shape::tiny().to_json()).unwrap(), Shape::tiny());
    }

    #[test]
    fn quick_heads_stand_beside_the_best_and_are_found_by_role() {
        let shape = Shape::tiny().with_quick_heads();
        let json = shape.to_json();
        assert_eq!(json.matches("\"heads\":\"quick\"").count(), 2, "{json}");
        assert!(!json.contains("best"), "{json}");
        assert_eq!(Shape::from_json(&json).unwrap(), shape);
        assert_eq!(shape.heads(), Heads::ALL);
        assert_eq!(Shape::tiny().heads(), [Heads::Best]);
        for role in [1, 2] {
            for heads in Heads::ALL {
                let head = shape.head(role, heads).unwrap();
                assert_eq!((head.role, head.heads), (role, heads));
            }
            assert_eq!(Shape::tiny().head(role, Heads::Quick), None);
        }
    }

    #[test]
    fn marks_that_are_unknown_or_fit_nothing_are_refused() {
        let both = || Shape::tiny().with_quick_heads();
        for (field, value, word) in [
            ("/gg/2/heads", "\"fast\"", "fast"),
            ("/gg/2/heads", "3", "metadata"),
            ("/gg/2/heads", "null", "metadata"),
            ("/gg/2/heads", "\"best\"", "role"),
            ("/gg/2/role", "2", "role"),
            ("/gg/2/children", "1", "children"),
            ("/gg/3/channels", "6", "channels"),
        ] {
            let error = altered_from(both(), field, value).unwrap_err();
            assert!(matches!(error, Error::Malformed { .. }), "{error}");
            assert!(error.to_string().contains(word), "{field}: {error}");
        }
        let mut alone = both();
        alone.gg.remove(0);
        let mut first = both();
        first.gg.rotate_left(2);
        let mut one = both();
        one.gg.pop();
        for (shape, word) in [(alone, "heads"), (first, "heads"), (one, "1 quick heads")] {
            let error = Shape::from_json(&shape.to_json()).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }

    #[test]
    fn a_key_that_means_nothing_here_is_ignored() {
        let json = Shape::tiny().to_json().replacen('{', "{\"steps\": 5, ", 1);
        assert_eq!(Shape::from_json(&json).unwrap(), Shape::tiny());
    }

    #[test]
    fn a_field_out_of_range_is_named() {
        for (field, value) in [
            ("/channels", "6"),
            ("/channels", "0"),
            ("/channels", "1000000"),
            ("/latents", "65"),
            ("/latent_roles", "0"),
            ("/latent_roles", "4"),
            ("/fr_roles", "2"),
            ("/fr_roles", "4"),
            ("/base_channels", "260"),
            ("/near_channels/1", "6"),
            ("/pem_blocks", "17"),
            ("/latent_max", "32"),
            ("/latent_max", "0"),
            ("/latent_shift", "200"),
            ("/scale_range", "0"),
            ("/blur", "-1"),
            ("/offset_range", "1e30"),
            ("/gg/0/role", "2"),
            ("/gg/0/role", "0"),
            ("/gg/1/children", "8"),
            ("/gg/0/channels", "7"),
            ("/gg/0/blocks_after", "99"),
        ] {
            let key = field.rsplit('/').find(|part| part.parse::<u8>().is_err());
            let name = key.unwrap().split('_').next().unwrap();
            let error = altered(field, value).unwrap_err();
            assert!(matches!(error, Error::Malformed { .. }), "{field} = {value}: {error}");
            assert!(error.to_string().contains(name), "{field} = {value}: {error}");
        }
        for (field, value) in [
            ("/channels", "-8"),
            ("/upsample", "\"cubic\""),
            ("/near_channels", "[8]"),
            ("/learning", "1"),
            ("/latent_max", "40000"),
        ] {
            assert!(
                matches!(altered(field, value), Err(Error::Malformed { .. })),
                "{field} = {value}"
            );
        }
    }

    #[test]
    fn another_format_is_not_supported() {
        assert!(matches!(altered("/format", "2"), Err(Error::Unsupported { .. })));
    }
}
