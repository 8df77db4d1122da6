"""Coloured points as files that other programs open: PLY (Stanford, binary) and PCD (Point Cloud Library, binary)."""

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]


def ply_bytes(points_m: Float32, colours: UInt8, sigma_m: Float32) -> bytes:
    """Binary little-endian PLY: x, y, z, red, green, blue, sigma.

    Args:
        points_m: shape (n, 3).
        colours: shape (n, 3), red, green, blue.
        sigma_m: shape (n,), written as a property of its own, which programs that do not know it skip.
    """
    table = np.empty(len(points_m), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "u1", (3,)), ("sigma", "<f4")])
    for i, axis in enumerate("xyz"):
        table[axis] = points_m[:, i]
    table["rgb"], table["sigma"] = colours, sigma_m
    names = [*(f"float {a}" for a in "xyz"), *(f"uchar {c}" for c in ("red", "green", "blue")), "float sigma"]
    header = ["ply", "format binary_little_endian 1.0", "comment metres", f"element vertex {len(table)}"]
    header += [f"property {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


def pcd_bytes(points_m: Float32, colours: UInt8, sigma_m: Float32) -> bytes:
    """PCD 0.7 with binary data: x, y, z, rgb (packed 0x00RRGGBB in a float, as its format has it), sigma.

    Arguments as in `ply_bytes`.
    """
    table = np.empty(len(points_m), [(name, "<f4") for name in ("x", "y", "z", "rgb", "sigma")])
    for i, axis in enumerate("xyz"):
        table[axis] = points_m[:, i]
    packed = colours.astype("<u4")
    table["rgb"] = ((packed[:, 0] << 16) | (packed[:, 1] << 8) | packed[:, 2]).astype("<u4").view("<f4")
    table["sigma"] = sigma_m
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb sigma\nSIZE 4 4 4 4 4\n"
        f"TYPE F F F F F\nCOUNT 1 1 1 1 1\nWIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(table)}\nDATA binary\n"
    )
    return header.encode("ascii") + table.tobytes()
