// b2p: point-cloud streams to 3D Gaussians and pictures. Made by cbindgen from capi/src; see the README.

#ifndef B2P_H
#define B2P_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Rules. Every object is freed by the function named after it, once; NULL is ignored there. Functions that can fail return a status,
// and put a text of at most `size` bytes, zero at the end, into `message`, which may be NULL. What takes a `const` object may be
// called from several threads at once, everything else from one thread at a time. There is no global state. Nothing of Rust
// unwinds across the FFI boundary: a defect inside the library is reported as B2P_STATUS_INTERNAL.

// How a function ended.
typedef enum b2p_status {
  // As it should.
  B2P_STATUS_OK = 0,
  // A file could not be read.
  B2P_STATUS_IO = 1,
  // The input ends before it is complete.
  B2P_STATUS_TRUNCATED = 2,
  // The bytes are not what was written.
  B2P_STATUS_CHECKSUM = 3,
  // The stream was made with another model.
  B2P_STATUS_MODEL = 4,
  // Encoder and decoder did not compute the same.
  B2P_STATUS_DETERMINISM = 5,
  // The input asks for more than the limits allow.
  B2P_STATUS_LIMIT = 6,
  // Well-formed, but not supported.
  B2P_STATUS_UNSUPPORTED = 7,
  // The input breaks the format.
  B2P_STATUS_MALFORMED = 8,
  // Another thread has cancelled.
  B2P_STATUS_CANCELLED = 9,
  // The caller asked for something that makes no sense: an argument is NULL, out of range, or too small.
  B2P_STATUS_USAGE = 10,
  // A defect in the library.
  B2P_STATUS_INTERNAL = 11,
} b2p_status;

// What makes Gaussians of a level.
typedef enum b2p_heads {
  // The best heads of a model.
  B2P_HEADS_BEST = 0,
  // Its quick ones: less accurate in a fraction of the time. Only some models have them.
  B2P_HEADS_QUICK = 1,
  // Opaque discs, which no model is needed for. Streams of version 2 have none.
  B2P_HEADS_SURFELS = 2,
} b2p_heads;

// A switch that stops decodings from another thread.
typedef struct b2p_cancel b2p_cancel;

// A stream or a scene that is decoded as its bytes arrive.
typedef struct b2p_decoding b2p_decoding;

// Gaussians of a level.
typedef struct b2p_gaussians b2p_gaussians;

// Learned heads that draw streams of version 3, ready to run. Any number of decodings share them, in any threads.
typedef struct b2p_heads_model b2p_heads_model;

// A model, ready to run. Any number of decodings share it, in any threads.
typedef struct b2p_model b2p_model;

// The voxels of a level with their colours.
typedef struct b2p_points b2p_points;

// What an input may ask for.
typedef struct b2p_limits {
  // Voxels of a level.
  uint64_t max_points;
  // Pixels of a picture.
  uint64_t max_pixels;
  // Bytes that one input may make the library reserve.
  uint64_t max_bytes;
  // Octree levels.
  uint8_t max_depth;
} b2p_limits;

// Where the numbers of Gaussians lie, until these are freed. Coordinates are those of the cube frame, in which the voxel cube reaches
// from -1 to 1; `origin` and `unit` lead to the world's: world = origin + (position + 1) * unit.
typedef struct b2p_arrays {
  // How many Gaussians.
  size_t count;
  // Centres x, y, z: 3 * count numbers.
  const float *position;
  // Standard deviations along the Gaussian's own axes: 3 * count numbers.
  const float *scale;
  // Unit quaternions w, x, y, z: 4 * count numbers.
  const float *rotation;
  // Opacities in [0, 1]: count numbers.
  const float *opacity;
  // Red, green, blue in [0, 1], display-referred: 3 * count numbers.
  const float *colour;
  // The world coordinates of the cube's lowest corner.
  double origin[3];
  // One unit of the cube frame in the world's.
  double unit;
} b2p_arrays;

// Takes a part of the Gaussians, whose numbers are there until it returns. Gives false to have no more of them. It must not unwind,
// and may not call functions with the decoding that the Gaussians come from.
typedef bool (*b2p_part)(const struct b2p_arrays *arrays, void *context);

// Where the numbers of points lie, until these are freed. A voxel with coordinates `c` covers `origin + c * voxel_size` to
// `origin + (c + 1) * voxel_size` in the world, along each axis; its point is the middle.
typedef struct b2p_point_arrays {
  // How many points.
  size_t count;
  // Coordinates x, y, z of voxels, below 2^level: 3 * count numbers.
  const uint32_t *coordinate;
  // Red, green, blue, display-referred: 3 * count bytes.
  const uint8_t *colour;
  // The level of the octree.
  uint8_t level;
  // The world coordinates of the cube's lowest corner.
  double origin[3];
  // The edge of a voxel of this level in the world.
  double voxel_size;
} b2p_point_arrays;

// A camera on a sphere around the cube's centre, looking at it, and what is behind the Gaussians.
typedef struct b2p_camera {
  // Degrees around the vertical axis.
  double azimuth;
  // Degrees above the horizon.
  double elevation;
  // From the cube's centre; the cube reaches from -1 to 1.
  double distance;
  // Horizontal field of view in degrees.
  double fov;
  // Pixels side by side.
  uint32_t width;
  // Rows of pixels.
  uint32_t height;
  // Red, green, blue of the background in [0, 1], if it is not transparent.
  float background[3];
  // Whether the background lets light through.
  bool transparent;
} b2p_camera;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Limits for anything: 2^26 points, 2^26 pixels, 2 GiB. What NULL stands for.
struct b2p_limits b2p_limits_default(void);

// Limits for boards with 512 MB of memory.
struct b2p_limits b2p_limits_embedded(void);

// No limits but the format's, for input that is trusted.
struct b2p_limits b2p_limits_unlimited(void);

// The library's version, such as "0.1.0".
const char *b2p_version(void);

// Loads a model file. Fails with IO, MALFORMED, UNSUPPORTED, USAGE.
//
// # Safety
// `path` is NULL or a string; `model` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_model_open(const char *path,
                               struct b2p_model **model,
                               char *message,
                               size_t size);

// Loads a model file's content, which is not needed afterwards. Fails with MALFORMED, UNSUPPORTED, USAGE.
//
// # Safety
// `bytes` leads to `length` bytes; `model` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_model_from_bytes(const uint8_t *bytes,
                                     size_t length,
                                     struct b2p_model **model,
                                     char *message,
                                     size_t size);

// Frees a model. Decodings that were started with it go on.
//
// # Safety
// `model` is NULL or came from this library, and is not used any more.
void b2p_model_free(struct b2p_model *model);

// Loads the content of a file of learned heads, which is not needed afterwards. Fails with MALFORMED, UNSUPPORTED, USAGE.
//
// # Safety
// `bytes` leads to `length` bytes; `heads` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_heads_model_from_bytes(const uint8_t *bytes,
                                           size_t length,
                                           struct b2p_heads_model **heads,
                                           char *message,
                                           size_t size);

// Frees learned heads. Decodings that draw with them go on.
//
// # Safety
// `heads` is NULL or came from this library, and is not used any more.
void b2p_heads_model_free(struct b2p_heads_model *heads);

// A new switch.
//
// # Safety
// `cancel` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_cancel_new(struct b2p_cancel **cancel, char *message, size_t size);

// Throws the switch, from any thread: what decodes with it ends with CANCELLED before it begins its next slice or step.
//
// # Safety
// `cancel` is NULL or a switch.
void b2p_cancel_throw(const struct b2p_cancel *cancel);

// Frees a switch. Decodings that were started with it go on.
//
// # Safety
// `cancel` is NULL or came from this library, and is not used any more.
void b2p_cancel_free(struct b2p_cancel *cancel);

// Begins to decode a stream of either version, or a scene of blocks, down to `level`, or, if that is negative, to the finest level that has Gaussians. `limits`
// and `cancel` may be NULL, and so may `model`, which streams of version 3 do not need: one of version 2 then fails with MODEL. Fails with
// USAGE.
//
// # Safety
// `model` is NULL or a model; `limits` and `cancel` are NULL or what they say; `decoding` is writable; `message` is NULL or leads to `size`
// bytes.
enum b2p_status b2p_decoding_start(const struct b2p_model *model,
                                   const struct b2p_limits *limits,
                                   const struct b2p_cancel *cancel,
                                   int32_t level,
                                   struct b2p_decoding **decoding,
                                   char *message,
                                   size_t size);

// Makes Gaussians with a model's quick heads from now on, or with its best. What has been decoded stays. Fails with UNSUPPORTED, USAGE.
//
// # Safety
// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_use_quick_heads(struct b2p_decoding *decoding,
                                             bool quick,
                                             char *message,
                                             size_t size);

// Makes Gaussians with these heads from now on: one of b2p_heads. At first they are the best there are. What has been decoded stays. Fails with
// UNSUPPORTED, USAGE.
//
// # Safety
// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_use_heads(struct b2p_decoding *decoding,
                                       int32_t heads,
                                       char *message,
                                       size_t size);

// Draws streams of version 3 with these learned heads from now on. What has been decoded stays. Fails with USAGE.
//
// # Safety
// `decoding` is a decoding; `heads` are learned heads; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_use_heads_model(struct b2p_decoding *decoding,
                                             const struct b2p_heads_model *heads,
                                             char *message,
                                             size_t size);

// Takes the next bytes of the stream, which are not needed afterwards. Decodes nothing yet. Bytes of a scene of blocks are kept until
// all of it is there; its levels are decoded when Gaussians or points are asked for. Fails with USAGE, and with LIMIT for a scene.
//
// # Safety
// `decoding` is a decoding; `bytes` leads to `length` bytes; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_push(struct b2p_decoding *decoding,
                                  const uint8_t *bytes,
                                  size_t length,
                                  char *message,
                                  size_t size);

// Decodes the next level if all of it has come: `level` is then its number, else -1. To be called until it is -1. After a failure
// the level reached before can still be had. Fails with everything but IO, TRUNCATED and INTERNAL.
//
// # Safety
// `decoding` is a decoding; `level` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_advance(struct b2p_decoding *decoding,
                                     int32_t *level,
                                     char *message,
                                     size_t size);

// Decodes what is left, knowing that no more bytes will come. Fails as b2p_decoding_advance does, and with TRUNCATED if the level
// to end with is not whole, or, where none was named, if the stream ends elsewhere than after one of its levels.
//
// # Safety
// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_finish(struct b2p_decoding *decoding,
                                    char *message,
                                    size_t size);

// The deepest level decoded so far, or -1.
//
// # Safety
// `decoding` is NULL or a decoding.
int32_t b2p_decoding_level(const struct b2p_decoding *decoding);

// Frees a decoding. Gaussians that were made of it stay.
//
// # Safety
// `decoding` is NULL or came from this library, and is not used any more.
void b2p_decoding_free(struct b2p_decoding *decoding);

// Makes the Gaussians of the deepest level decoded so far. Fails with UNSUPPORTED if it has none, LIMIT, CANCELLED, USAGE, and for a
// scene as b2p_decoding_advance does.
//
// # Safety
// `decoding` is a decoding; `gaussians` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_gaussians(const struct b2p_decoding *decoding,
                                       struct b2p_gaussians **gaussians,
                                       char *message,
                                       size_t size);

// Where the numbers of the Gaussians lie. Fails with USAGE.
//
// # Safety
// `gaussians` are Gaussians; `arrays` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_gaussians_arrays(const struct b2p_gaussians *gaussians,
                                     struct b2p_arrays *arrays,
                                     char *message,
                                     size_t size);

// Frees Gaussians, and with them what b2p_gaussians_arrays told.
//
// # Safety
// `gaussians` is NULL or came from this library, and is not used any more.
void b2p_gaussians_free(struct b2p_gaussians *gaussians);

// Says, before the first bytes come, that Gaussians will be asked for in parts alone: limits then count no more of them than there are
// in memory. Fails with USAGE.
//
// # Safety
// `decoding` is a decoding; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_use_parts(struct b2p_decoding *decoding,
                                       char *message,
                                       size_t size);

// Makes the Gaussians of the deepest level decoded so far, and calls `each` with `context` and one part of them after the other, in
// order. No more than a part of a stream is in memory at a time, 131,072 Gaussians; those of a scene, or of a stream of version 2, come
// in one part. A part may be empty. Fails as b2p_decoding_gaussians does, and with CANCELLED when `each` gives false.
//
// # Safety
// `decoding` is a decoding; `each` may be called with `context`; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_gaussians_in_parts(const struct b2p_decoding *decoding,
                                                b2p_part each,
                                                void *context,
                                                char *message,
                                                size_t size);

// The points of the deepest level decoded so far, in Morton order. Fails with UNSUPPORTED for streams of version 2, whose colours
// are those of Gaussians, with USAGE, and for a scene as b2p_decoding_advance does.
//
// # Safety
// `decoding` is a decoding; `points` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_decoding_points(const struct b2p_decoding *decoding,
                                    struct b2p_points **points,
                                    char *message,
                                    size_t size);

// Where the numbers of the points lie. Fails with USAGE.
//
// # Safety
// `points` are points; `arrays` is writable; `message` is NULL or leads to `size` bytes.
enum b2p_status b2p_points_arrays(const struct b2p_points *points,
                                  struct b2p_point_arrays *arrays,
                                  char *message,
                                  size_t size);

// Frees points, and with them what b2p_points_arrays told.
//
// # Safety
// `points` is NULL or came from this library, and is not used any more.
void b2p_points_free(struct b2p_points *points);

// Draws Gaussians into `pixels`: 4 * width * height bytes of red, green, blue, alpha, premultiplied, row by row from the top left.
// `limits` may be NULL. Fails with USAGE if the camera is none or `length` is another, and with LIMIT.
//
// # Safety
// `gaussians` are Gaussians; `camera` is a camera; `limits` is NULL or limits; `pixels` leads to `length` writable bytes; `message` is
// NULL or leads to `size` bytes.
enum b2p_status b2p_render(const struct b2p_gaussians *gaussians,
                           const struct b2p_camera *camera,
                           const struct b2p_limits *limits,
                           uint8_t *pixels,
                           size_t length,
                           char *message,
                           size_t size);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* B2P_H */
