"""Decoders on bytes that are anything: a message or an error of one line, never anything else."""

import json

import logmaker
import numpy as np
import pytest
from decode_helpers import TIME, cdr, foxglove, ros
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given, settings
from hypothesis import strategies as st

from surecut.factors.errors import LogError
from surecut.io.decode import ChannelInfo, Decoder, decoder_for
from surecut.io.messages import CloudBody, DepthBody, ImageBody
from surecut.io.pixels import ENCODINGS, CompressedPixels, RawPixels, to_depth_m, to_uint8

WRITTEN = {type_name: message for _, type_name, message in logmaker.messages(0)}


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(WRITTEN)), st.data())
def test_damaged_cdr_gives_a_message_or_a_log_error(type_name, data):
    content = bytearray(cdr(type_name, WRITTEN[type_name]))
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, min(len(content) - 1, 400)))] = data.draw(st.integers(0, 255))
    content = content[: data.draw(st.integers(0, len(content)))]
    try_all(ros(type_name), bytes(content))


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(WRITTEN)), st.binary(max_size=200))
def test_random_cdr_gives_a_message_or_a_log_error(type_name, data):
    try_all(ros(type_name), b"\x00\x01\x00\x00" + data)


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from([RawImage, CompressedImage, CameraCalibration, PointCloud, PoseInFrame]), st.binary(max_size=100)
)
def test_random_protobuf_gives_a_message_or_a_log_error(kind, data):
    try_all(foxglove(kind), data)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["foxglove.RawImage", "foxglove.CameraCalibration", "foxglove.PointCloud", "foxglove.PoseInFrame"]),
    st.one_of(
        st.binary(max_size=50),
        st.dictionaries(
            st.sampled_from(["timestamp", "K", "D", "data", "width", "pose", "fields", "point_stride", "encoding"]),
            st.recursive(
                st.one_of(st.none(), st.integers(), st.text(max_size=5), st.floats()),
                lambda inner: st.one_of(
                    st.lists(inner, max_size=9), st.dictionaries(st.sampled_from(["sec", "nsec", "x"]), inner)
                ),
            ),
        ).map(lambda value: json.dumps(value).encode()),
    ),
)
def test_random_json_gives_a_message_or_a_log_error(name, data):
    try_all(decoder_for(ChannelInfo("/t", "json", name, "jsonschema", b"")), data)


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from([*ENCODINGS, "other"]),
    st.integers(-1, 9),
    st.integers(-1, 9),
    st.integers(0, 99),
    st.booleans(),
    st.binary(max_size=300),
)
def test_any_raw_image_gives_pixels_or_a_log_error(encoding, width, height, step, big, data):
    pixels = RawPixels(encoding, width, height, step, big, np.frombuffer(data, np.uint8))
    for convert in (to_uint8, to_depth_m):
        try:
            assert convert(pixels).shape[:2] == (height, width)
        except LogError:
            pass


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from(["jpeg", "png", "16UC1; compressedDepth png", "32FC1; compressedDepth png"]),
    st.binary(max_size=300),
    st.booleans(),
)
def test_any_compressed_image_gives_pixels_or_a_log_error(format_, data, as_png):
    content = (b"\x89PNG\r\n\x1a\n" if as_png else b"") + data
    for convert in (to_uint8, to_depth_m):
        with pytest.raises(LogError):
            convert(CompressedPixels(format_, np.frombuffer(content, np.uint8)))


@settings(max_examples=30, deadline=None)
@given(st.text(max_size=60), st.binary(max_size=60), st.sampled_from(["ros2msg", "protobuf", "ros2idl"]))
def test_any_definition_gives_a_decoder_or_a_log_error(name, text, encoding):
    message_encoding = "protobuf" if encoding == "protobuf" else "cdr"
    try:
        decoder = decoder_for(ChannelInfo("/t", message_encoding, name, encoding, text))
    except LogError:
        return
    try_all(decoder, b"\x00\x01\x00\x00abcdefgh")


def try_all(decode: Decoder, data: bytes) -> None:
    try:
        body = decode(data, TIME).body
        if isinstance(body, ImageBody):
            body.pixels()
        elif isinstance(body, DepthBody):
            body.depth_m()
        elif isinstance(body, CloudBody):
            body.points_m()
    except LogError as caught:
        text = str(caught)
    else:
        return
    assert "\n" not in text
