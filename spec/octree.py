"""Levels of an octree and their neighbours: clauses 2.3 and 2.4 of docs/format.md."""

ABSENT = -1
AXES = [(k % 3 != 1) + (k // 3 % 3 != 1) + (k // 9 != 1) for k in range(27)]
OFFSETS = [(k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1) for k in range(27)]
FACES = [4, 10, 12, 14, 16, 22]
EDGES = [k for k in range(27) if AXES[k] == 2]
CORNERS = [k for k in range(27) if AXES[k] == 3]
CELLS = [(i % 4 - 1, i // 4 % 4 - 1, i // 16 - 1) for i in range(64)]  # 4.6.1
BEFORE = [k for k in range(27) if min(OFFSETS[k]) < 0]


def octant_xyz(octant):
    """Coordinates of an octant."""
    return octant & 1, octant >> 1 & 1, octant >> 2


class Voxels:
    """The voxels of one level in Morton order."""

    def __init__(self, level, keys, coordinates):
        self.level, self.keys, self.coordinates = level, keys, coordinates
        self.places = places = {c: i for i, c in enumerate(coordinates)}
        self.near = [
            [places.get((x + dx, y + dy, z + dz), ABSENT) for dx, dy, dz in OFFSETS] for x, y, z in coordinates
        ]
        self.masks = self.first = None

    def __len__(self):
        return len(self.keys)

    def grow(self, masks):
        """The next level, from an occupancy for each voxel (2.3.3)."""
        keys, coordinates, self.first = [], [], []
        self.masks = masks
        for key, (x, y, z), mask in zip(self.keys, self.coordinates, masks):
            self.first.append(len(keys))
            for octant in range(8):
                if mask >> octant & 1:
                    dx, dy, dz = octant_xyz(octant)
                    keys.append(key << 3 | octant)
                    coordinates.append((2 * x + dx, 2 * y + dy, 2 * z + dz))
        return Voxels(self.level + 1, keys, coordinates)
