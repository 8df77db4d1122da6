"""Decoders as a log would describe them, and messages to decode."""

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from surecut.io.decode import ChannelInfo, Decoder, decoder_for
from surecut.io.pixels import RawPixels
from surecut.io.schemas import schema, typestore

TIME = 5_000_000_123


def ros(type_name: str, encoding: str = "cdr") -> Decoder:
    return decoder_for(ChannelInfo("/t", encoding, type_name, "ros2msg", schema(type_name).text.encode()))


def cdr(type_name: str, message) -> bytes:
    return bytes(typestore().serialize_cdr(message, type_name))


def foxglove(kind) -> Decoder:
    """A decoder for a protobuf class, by a descriptor set as a log carries it."""
    files = FileDescriptorSet()
    seen = set()

    def add(file):
        if file.name not in seen:
            seen.add(file.name)
            for dependency in file.dependencies:
                add(dependency)
            file.CopyToProto(files.file.add())

    add(kind.DESCRIPTOR.file)
    name = kind.DESCRIPTOR.full_name
    return decoder_for(ChannelInfo("/t", "protobuf", name, "protobuf", files.SerializeToString()))


def stamped(message):
    message.timestamp.FromNanoseconds(TIME)
    message.frame_id = "cam"
    return message


def raw(encoding: str, array: np.ndarray, pad: int = 0, big: bool = False) -> RawPixels:
    data = np.ascontiguousarray(array)
    rows = data.reshape(data.shape[0], -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    return RawPixels(encoding, array.shape[1], array.shape[0], rows.shape[1], big, rows.reshape(-1))
