"""Image bytes to arrays: raw encodings of ROS 2 and Foxglove, JPEG and PNG, compressed depth.

OpenCV is used to decompress and to convert colours, nothing else.
"""

import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.errors import LogError

UInt8 = NDArray[np.uint8]
Float32 = NDArray[np.float32]
MAXIMUM_PIXELS = 1 << 28
"""Larger images are refused: 16 times the largest sensor in use, and a hostile header must not fill the memory."""

_TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR}
# OpenCV names a Bayer pattern by the second row's second and third pixel, ROS by the first row's first two.
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
}
_YUV = {
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "yuyv": cv2.COLOR_YUV2BGR_YUY2,
}
_SAME = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "bgr": "bgr8", "rgb": "rgb8"}
_LAYOUT: dict[str, tuple[type[np.generic], int]] = {
    "mono8": (np.uint8, 1),
    "bgr8": (np.uint8, 3),
    "rgb8": (np.uint8, 3),
    "bgra8": (np.uint8, 4),
    "rgba8": (np.uint8, 4),
    "mono16": (np.uint16, 1),
    "16UC1": (np.uint16, 1),
    "32FC1": (np.float32, 1),
    **dict.fromkeys(_BAYER, (np.uint8, 1)),
    **dict.fromkeys(_YUV, (np.uint8, 2)),
}
ENCODINGS = tuple(_LAYOUT)
DEPTH_ENCODINGS = ("16UC1", "32FC1")


class PixelError(LogError):
    """The bytes of one image are no image."""


@dataclass(frozen=True, slots=True)
class RawPixels:
    """An uncompressed image as it came: `data` holds `height` rows of `step` bytes."""

    encoding: str
    width: int
    height: int
    step: int
    big_endian: bool
    data: NDArray[np.uint8]

    def array(self) -> NDArray[Any]:
        """Shape (height, width) or (height, width, channels) in the encoding's type; a view where that is possible.

        Raises:
            PixelError: unknown encoding, or the sizes contradict each other.
        """
        layout = _LAYOUT.get(self.encoding)
        if layout is None:
            raise PixelError(f"unknown encoding {self.encoding!r}; known: {', '.join(_LAYOUT)}")
        dtype, channels = np.dtype(layout[0]), layout[1]
        row = self.width * channels * dtype.itemsize
        if min(self.width, self.height) <= 0 or self.width * self.height > MAXIMUM_PIXELS:
            raise PixelError(f"image size {self.width}x{self.height}")
        if self.step < row or self.data.size < self.step * (self.height - 1) + row:
            size = f"{self.width}x{self.height}, step {self.step}"
            raise PixelError(f"{self.data.size} bytes are no {self.encoding} image of {size}")
        rows = np.lib.stride_tricks.as_strided(self.data, (self.height, row), (self.step, 1), writeable=False)
        pixels = np.ascontiguousarray(rows) if dtype.itemsize > 1 else rows
        pixels = pixels.view(dtype.newbyteorder(">" if self.big_endian else "<"))
        return pixels if channels == 1 else pixels.reshape(self.height, self.width, channels)


@dataclass(frozen=True, slots=True)
class CompressedPixels:
    """An image as JPEG, PNG, or `compressedDepth` (PNG behind a header of 12 bytes)."""

    format: str
    data: NDArray[np.uint8]

    def array(self) -> NDArray[Any]:
        """Decompressed: uint8 (height, width) or (height, width, 3) BGR, or uint16 or float32 (height, width).

        Raises:
            PixelError: not an image.
        """
        if "compressedDepth" in self.format:
            return _compressed_depth(self.format, self.data)
        return _decompress(self.data)


def to_uint8(pixels: RawPixels | CompressedPixels) -> UInt8:
    """Grey (height, width) or BGR (height, width, 3), uint8, possibly a read-only view of the message.

    Raises:
        PixelError: not an image, or one of depths.
    """
    array = pixels.array()
    if isinstance(pixels, CompressedPixels):
        return _eight_bits(array)
    encoding = pixels.encoding
    if encoding in DEPTH_ENCODINGS:
        raise PixelError(f"{encoding} is an encoding of depth, not of a picture")
    conversion = {**_BAYER, **_YUV, **_TO_BGR}.get(encoding)
    if conversion is None:
        return _eight_bits(array)
    try:
        return _uint8(cv2.cvtColor(array, conversion))
    except cv2.error as error:
        raise PixelError(f"an image of {pixels.width}x{pixels.height} pixels cannot be {encoding}") from error


def to_depth_m(pixels: RawPixels | CompressedPixels) -> Float32:
    """Depth in metres, shape (height, width), NaN where there is none.

    Integers are millimetres with 0 and the type's largest value as `no measurement`; floats are metres.

    Raises:
        PixelError: not a depth image.
    """
    array = pixels.array()
    if array.ndim != 2 or array.dtype.itemsize < 2:
        raise PixelError(f"an image of shape {array.shape}, {array.dtype} holds no depth")
    if array.dtype.kind == "u":
        depth = array.astype(np.float32) * np.float32(0.001)
        depth[(array == 0) | (array == 65535)] = np.nan
        return depth
    depth = array.astype(np.float32)
    depth[~np.isfinite(depth) | (depth <= 0)] = np.nan
    return depth


def _uint8(array: NDArray[Any]) -> UInt8:
    return np.asarray(array, dtype=np.uint8)


def _eight_bits(array: NDArray[Any]) -> UInt8:
    if array.dtype.kind == "f":
        raise PixelError("an image of floats is no picture")
    return _uint8(array >> 8) if array.dtype.itemsize == 2 else _uint8(array)


def _decompress(data: NDArray[np.uint8], header: int = 0) -> NDArray[Any]:
    size = _png_size(data[header : header + 24].tobytes())
    if size is not None and size[0] * size[1] > MAXIMUM_PIXELS:
        raise PixelError(f"image size {size[0]}x{size[1]}")
    if data.size <= header:
        raise PixelError("an empty image")
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
    try:
        array = cv2.imdecode(data[header:], flags)
    except cv2.error as error:
        raise PixelError(f"not an image ({' '.join(str(error).split())[:120]})") from error
    if array is None:
        raise PixelError(f"{data.size} bytes are no JPEG or PNG image")
    return array


def _png_size(head: bytes) -> tuple[int, int] | None:
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n":
        return None
    width, height = struct.unpack(">II", head[16:24])
    return width, height


def _compressed_depth(format_: str, data: NDArray[np.uint8]) -> NDArray[Any]:
    """`compressed_depth_image_transport`: int32 format, float32 A and B, then a PNG of 16 bits.

    16UC1 is stored as it is; 32FC1 as inverse depth: depth = A / (value - B), 0 for none.
    """
    if data.size < 12:
        raise PixelError(f"{data.size} bytes are no compressed depth image")
    array = _decompress(data, header=12)
    if array.ndim != 2 or array.dtype != np.uint16:
        raise PixelError(f"a compressed depth image of shape {array.shape}, {array.dtype}")
    if not format_.strip().startswith("32FC1"):
        return array
    a, b = np.frombuffer(data[4:12].tobytes(), dtype="<f4").astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = a / (array - b)
    return np.where(array == 0, np.nan, depth).astype(np.float32)


def normalised(encoding: str) -> str:
    """The encoding's usual name."""
    return _SAME.get(encoding, encoding)
