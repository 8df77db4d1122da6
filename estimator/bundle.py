"""All measurements of one stamp: what the engine takes at a time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ..factors.measurements import CloudFrame, CylinderSighting, MarkerSighting, OutlineSighting, Pick, StereoFrame


@dataclass(frozen=True, slots=True)
class Bundle:
    """All measurements of one stamp."""

    stamp_ns: int
    frame: StereoFrame | None = None
    sightings: tuple[MarkerSighting, ...] = ()
    picks: tuple[Pick, ...] = ()
    depths_m: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Surface depth and its sigma under the picks of this stamp, by point id, where it could be measured."""
    outlines: tuple[OutlineSighting, ...] = ()
    cloud: CloudFrame | None = None
    cylinders: tuple[CylinderSighting, ...] = ()
    """Pipes in the cloud, where they were looked for elsewhere."""


def bundles(measurements: Sequence[object]) -> list[Bundle]:
    """Groups measurements of one stamp; they come out in the order of their stamps."""
    groups: dict[int, list[object]] = {}
    for m in measurements:
        groups.setdefault(m.stamp_ns, []).append(m)  # type: ignore[attr-defined]
    return [_bundle(stamp, group) for stamp, group in sorted(groups.items())]


def _bundle(stamp_ns: int, group: list[object]) -> Bundle:
    def of(kind: type) -> tuple:
        return tuple(m for m in group if isinstance(m, kind))

    frames, clouds = of(StereoFrame), of(CloudFrame)
    return Bundle(
        stamp_ns,
        frames[0] if frames else None,
        of(MarkerSighting),
        of(Pick),
        {},
        of(OutlineSighting),
        clouds[0] if clouds else None,
        of(CylinderSighting),
    )
