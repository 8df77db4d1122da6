"""The result as JSON text: complete, lossless, the same bytes for the same result, and marked against edits by hand.

The fields of `Result` are written under their own names, with four exceptions that suit readers in other languages:
`poses` is an object by name and carries translation and quaternion beside the matrix, `calibration` and
`consistency.by_family` are objects by name, images are base64, and numbers that JSON lacks are the strings `NaN`,
`Infinity` and `-Infinity`. `sha256` covers everything but itself and `timing`, which differs from run to run.
"""

import base64
import binascii
import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..factors.errors import SurecutError
from .result import NearestSurface, PickRecord, PickView, PipeEstimate, PointEstimate, PoseEstimate, Result

FORMAT = 1
NON_FINITE = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}
BY_NAME = {"calibration": "name", "by_family": "family"}
"""Tuples that are written as objects, and the field that becomes the key."""
DERIVED_OF_POSE = ("frame", "translation_m", "rotation_wxyz")
HEAD = ("surecut", "log_sha256", "rig_sha256")
"""Keys of `Result.provenance` that are repeated at the head of the text."""
SHAPES: dict[type, dict[str, tuple[int, ...]]] = {
    PointEstimate: {"position_m": (3,), "covariance_m2": (3, 3), "axis": (3,), "budget": (3, 3)},
    NearestSurface: {"direction": (3,)},
    PickRecord: {"pixel": (2,)},
    PickView: {"pixel": (2,), "ellipse_px2": (2, 2)},
    PoseEstimate: {"matrix": (4, 4), "covariance": (6, 6)},
    PipeEstimate: {"point_m": (3,), "axis": (3,), "covariance": (7, 7)},
}


class ResultError(SurecutError):
    """A stored result cannot be used."""


def to_json(result: Result) -> str:
    """The result as text, UTF-8, one line feed at the end. Equal results give equal text."""
    body = _encode(result)
    body["poses"] = _poses_by_name(result.poses)
    head = {key: result.provenance.get(key, "") for key in HEAD}
    content = {**head, "format": FORMAT, **body}
    text = {**head, "format": FORMAT, "sha256": content_sha256(content), **body}
    return json.dumps(text, ensure_ascii=False, allow_nan=False, separators=(",", ":")) + "\n"


def from_json(text: str | bytes, name: str = "result") -> Result:
    """The result that `to_json` wrote.

    Raises:
        ResultError: no JSON, no result, of a newer version, edited since it was written, or incomplete.
    """
    data = _load(text, name)
    version = data.get("format")
    if not isinstance(version, int) or "sha256" not in data:
        raise ResultError(f"{name}: is no surecut result; `surecut optimise LOG -o RESULT.mcap` writes one")
    if version > FORMAT:
        written_by = data.get("surecut") or "newer"
        raise ResultError(f"{name}: format {version} of surecut {written_by}, this one reads {FORMAT}; update surecut")
    given = data.pop("sha256")
    if content_sha256(data) != given:
        raise ResultError(f"{name}: was changed after it was written (hash mismatch); run `surecut optimise` again")
    try:
        return _decode_result(data)
    except KeyError as error:
        raise ResultError(f"{name}: lacks {error.args[0]}; run `surecut optimise` again") from error
    except (TypeError, ValueError, AttributeError, binascii.Error) as error:
        raise ResultError(f"{name}: {' '.join(str(error).split())}; run `surecut optimise` again") from error


def stored_sha256(text: str | bytes) -> str:
    """The hash that a result carries, which `from_json` has checked."""
    return str(json.loads(text)["sha256"])


def content_sha256(content: Mapping[str, Any]) -> str:
    """Hash of the decoded JSON object, without `sha256` and `timing`, keys sorted, no white space."""
    kept = {key: value for key, value in content.items() if key not in ("sha256", "timing")}
    canonical = json.dumps(kept, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(canonical.encode("utf-8", "surrogatepass")).hexdigest()


def _load(text: str | bytes, name: str) -> dict[str, Any]:
    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} is no JSON number")

    try:
        data = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ResultError(f"{name}: is no JSON ({error}); give the file that `surecut optimise` wrote") from error
    if not isinstance(data, dict):
        raise ResultError(f"{name}: is no surecut result; `surecut optimise LOG -o RESULT.mcap` writes one")
    return data


def _encode(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _encode_field(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist() if np.isfinite(value).all() else _encode(value.tolist())
    if isinstance(value, np.generic):
        return _encode(value.item())
    if isinstance(value, Mapping):
        return {str(key): _encode(value[key]) for key in sorted(value)}
    if isinstance(value, tuple | list):
        return [_encode(item) for item in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, float) and not np.isfinite(value):
        return "NaN" if np.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def _encode_field(name: str, value: Any) -> Any:
    key = BY_NAME.get(name)
    if key is None:
        return _encode(value)
    encoded = {getattr(item, key): _encode(item) for item in value}
    if len(encoded) < len(value):
        raise ResultError(f"{name}: two entries have one {key}; every entry needs its own")
    return encoded


def _poses_by_name(poses: tuple[PoseEstimate, ...]) -> dict[str, Any]:
    """A second pose of one name (in another parent) stands under `name@parent`."""
    table: dict[str, Any] = {}
    for pose in poses:
        key = f"{pose.name}@{pose.parent}" if pose.name in table else pose.name
        if key in table:
            raise ResultError(f"poses: {pose.name} in {pose.parent} stands there twice")
        rotation = Rotation.from_matrix(pose.matrix[:3, :3]).as_quat(canonical=True, scalar_first=True)
        table[key] = {
            "frame": pose.parent,
            "translation_m": pose.matrix[:3, 3].tolist(),
            "rotation_wxyz": rotation.tolist(),
            **_encode(pose),
        }
    return table


def _decode_result(data: dict[str, Any]) -> Result:
    body = {key: value for key, value in data.items() if key not in (*HEAD, "format")}
    body["poses"] = [
        {key: value for key, value in pose.items() if key not in DERIVED_OF_POSE} for pose in body["poses"].values()
    ]
    return _decode_dataclass(Result, body, "")


def _decode_dataclass(kind: type, data: Any, where: str) -> Any:
    if not isinstance(data, dict):
        raise TypeError(f"{where} is no object")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    unknown = sorted(set(data) - set(fields))
    if unknown:
        raise ValueError(f"{where}{unknown[0]} is an unknown key")
    hints = typing.get_type_hints(kind)
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name not in data:
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise KeyError(f"{where}{name}")
            continue
        item = list(data[name].values()) if name in BY_NAME else data[name]
        values[name] = _decode(hints[name], item, f"{where}{name}", SHAPES.get(kind, {}).get(name))
    return kind(**values)


def _decode(hint: Any, data: Any, where: str, shape: tuple[int, ...] | None) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        rest = [a for a in arguments if a is not types.NoneType]
        return None if data is None else _decode(rest[0], data, where, shape)
    if origin in (np.ndarray, NDArray):  # NumPy 2.5 keeps its alias's name
        return _decode_array(data, where, shape)
    if origin is tuple:
        return tuple(_decode(arguments[0], item, f"{where}[{i}].", shape) for i, item in enumerate(_list(data, where)))
    if origin is dict:
        return {key: _decode(arguments[1], item, f"{where}.{key}", shape) for key, item in data.items()}
    if dataclasses.is_dataclass(hint):
        return _decode_dataclass(typing.cast(type, hint), data, where if where.endswith(".") else f"{where}.")
    if hint is bytes:
        return base64.b64decode(data, validate=True)
    return _decode_scalar(hint, data, where)


def _decode_scalar(hint: Any, data: Any, where: str) -> Any:
    if hint is float:
        if isinstance(data, str) and data in NON_FINITE:
            return NON_FINITE[data]
        if isinstance(data, int | float) and not isinstance(data, bool):
            return float(data)
    elif typing.get_origin(hint) is typing.Literal:
        if data in typing.get_args(hint):
            return data
    elif isinstance(data, hint) and (hint is bool or not isinstance(data, bool)):
        return data
    raise TypeError(f"{where}: {data!r} is of the wrong type")


def _list(data: Any, where: str) -> list[Any]:
    if not isinstance(data, list):
        raise TypeError(f"{where} is no list")
    return data


def _decode_array(data: Any, where: str, shape: tuple[int, ...] | None) -> Any:
    def number(item: Any) -> Any:
        return [number(i) for i in item] if isinstance(item, list) else _decode_scalar(float, item, where)

    array = np.array(number(_list(data, where)), dtype=np.float64)
    if shape is not None and array.shape != shape:
        raise ValueError(f"{where} has shape {array.shape} in place of {shape}")
    return array
