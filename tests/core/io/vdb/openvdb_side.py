"""What OpenVDB's own Python module makes of files; a script for another Python, which has that module and not this
package.

    openvdb_side.py check                        prints the module's name and the library's version, or fails
    openvdb_side.py read FILE QUERY.npz OUT.npz  describes all grids of FILE; QUERY holds where to look, see `describe`
    openvdb_side.py write FILE                   writes the grids of `make`

It keeps to the documented interface, and to syntax of Python 3.7.
"""

import json
import sys

import numpy as np

try:
    import openvdb
except ImportError:
    import pyopenvdb as openvdb  # its name before version 11


def plain(value):
    """Metadata as JSON has it: sequences become lists."""
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def known(metadata):
    return {
        key: plain(value) for key, value in metadata.items() if isinstance(value, (str, bool, int, float, list, tuple))
    }


def describe(grid, leaves, probes, points):
    """All that can be asked of a grid.

    leaves: (L, 3) corners of blocks of 8 voxels to copy. probes: (P, 3) voxels to ask for value and state.
    points: (Q, 3) index coordinates to transform.
    """
    vector = not isinstance(grid.background, (int, float))
    lows, highs, values, counts = [], [], [], []
    for item in grid.citerOnValues():
        lows.append(tuple(item.min))
        highs.append(tuple(item.max))
        values.append(tuple(item.value) if vector else item.value)
        counts.append(item.count)
    channels = (3,) if vector else ()
    blocks = np.zeros((len(leaves), 8, 8, 8, *channels), np.float32)
    for number, corner in enumerate(leaves.tolist()):
        block = np.zeros((8, 8, 8, *channels), np.float32)
        grid.copyToArray(block, ijk=tuple(corner))
        blocks[number] = block
    accessor = grid.getConstAccessor()
    probed = [accessor.getValue(tuple(p)) for p in probes.tolist()]
    box = grid.evalActiveVoxelBoundingBox()
    transform = grid.transform
    arrays = {
        "low": np.array(lows, np.int64).reshape(-1, 3),
        "high": np.array(highs, np.int64).reshape(-1, 3),
        "value": np.array(values, np.float64).reshape((-1, *channels)),
        "count": np.array(counts, np.int64),
        "blocks": blocks,
        "probed": np.array(probed, np.float64).reshape((-1, *channels)),
        "on": np.array([accessor.isValueOn(tuple(p)) for p in probes.tolist()], bool),
        "world": np.array([tuple(transform.indexToWorld(tuple(p))) for p in points.tolist()], np.float64).reshape(
            -1, 3
        ),
        "voxel_size": np.array(tuple(transform.voxelSize()), np.float64),
        "background": np.array(tuple(grid.background) if vector else grid.background, np.float64),
    }
    about = {
        "name": grid.name,
        "type": grid.valueTypeName,
        "class": grid.gridClass,
        "half": bool(grid.saveFloatAsHalf),
        "map": transform.typeName,
        "active": int(grid.activeVoxelCount()),
        "leaves": int(grid.leafCount()),
        "box": [list(map(int, corner)) for corner in box],
        "metadata": known(grid.metadata),
    }
    return arrays, about


def read(path, query, out):
    with np.load(query) as file:
        where = {name: file[name] for name in file.files}
    grids, metadata = openvdb.readAll(path)
    results, about = {}, []
    for number, grid in enumerate(grids):
        asked = [where.get(f"{grid.name}/{part}", np.zeros((0, 3))) for part in ("leaves", "probes", "points")]
        arrays, text = describe(grid, asked[0].astype(int), asked[1].astype(int), asked[2].astype(float))
        about.append(text)
        for name, value in arrays.items():
            results[f"{number}/{name}"] = value
    results["about"] = np.array(json.dumps({"grids": about, "metadata": known(metadata)}))
    np.savez(out, **results)


def linear(matrix):
    """A transform from rows for column vectors; OpenVDB multiplies row vectors from the left."""
    return openvdb.createLinearTransform(matrix=np.array(matrix, float).T.tolist())


def make():
    """Grids of every kind that the package reads."""
    rng = np.random.RandomState(0)
    array = rng.standard_normal((21, 9, 30)).astype(np.float32) * (rng.random_sample((21, 9, 30)) < 0.3)
    array = np.ascontiguousarray(array, np.float32)
    smoke = openvdb.FloatGrid()
    smoke.name, smoke.gridClass = "smoke", openvdb.GridClass.FOG_VOLUME
    smoke.copyFromArray(array, ijk=(-13, 5, 4090))
    smoke.transform = linear([[0.25, 0, 0, 1], [0, 0.5, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    smoke["note"], smoke["frame"], smoke["step"], smoke["offset"] = "from OpenVDB", 7, 0.5, (1.0, 2.5, -3.0)
    tiles = openvdb.FloatGrid(0.5)
    tiles.name, tiles.gridClass = "tiles", openvdb.GridClass.FOG_VOLUME
    tiles.fill((0, 0, 0), (4095, 4095, 4095), 3.0)  # one tile of the root, and below of every other level
    tiles.fill((-128, 0, 0), (-1, 127, 127), 2.0, active=False)
    tiles.fill((-4096, -8, -8), (-4089, -1, -1), -1.0)
    tiles.fill((-1000, -1000, -1000), (-990, -989, -988), 4.0)
    tiles.transform = linear([[0, -2, 0, 5], [1, 0, 0.375, 6], [0, 0, 3, 7], [0, 0, 0, 1]])
    half = openvdb.FloatGrid()
    half.name, half.gridClass, half.saveFloatAsHalf = "half", openvdb.GridClass.FOG_VOLUME, True
    half.copyFromArray(array)
    half.fill((1024, 0, 0), (1024 + 127, 127, 127), 0.75)
    vectors = openvdb.Vec3SGrid()
    vectors.name = "vectors"
    vectors.copyFromArray(np.ascontiguousarray(np.stack([array, -array, 2 * array], -1)), ijk=(3, 2, 1))
    empty = openvdb.FloatGrid()
    empty.name, empty.gridClass = "empty", openvdb.GridClass.FOG_VOLUME
    distances = openvdb.createLevelSetSphere(radius=5.0, center=(1.0, 2.0, 3.0), voxelSize=0.25, halfWidth=3.0)
    distances.name = "distances"
    return [smoke, tiles, half, vectors, empty, distances]


def main(words):
    if words[0] == "check":
        print(openvdb.__name__, ".".join(map(str, getattr(openvdb, "LIBRARY_VERSION", ("of unknown version",)))))
    elif words[0] == "read":
        read(*words[1:])
    elif words[0] == "write":
        openvdb.write(words[1], grids=make(), metadata={"source": "OpenVDB", "frame": 7, "step": 0.5})


if __name__ == "__main__":
    main(sys.argv[1:])
