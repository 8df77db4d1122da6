"""What the estimator can use of a recording, what is missing for an estimate in {b}, and what is odd."""

from dataclasses import dataclass

from ..factors.camera import CameraModel
from ..factors.rig import Camera, Rig
from ..io.inventory import Inventory, TopicInventory, check_stamps, unpaired

PAIR_TOLERANCE_NS = 1_000_000
CAMERAS = ("m_left", "m_right", "b_rgb", "b_depth")


@dataclass(frozen=True, slots=True)
class Findings:
    """Sentences, each with the cure where there is one."""

    usable: tuple[str, ...]
    missing: tuple[str, ...]
    odd: tuple[str, ...]


def check_log(inventory: Inventory, rig: Rig | None) -> Findings:
    """Compare a recording with a rig; without one, with the default topics."""
    log = _Log(inventory, rig)
    odd = [*inventory.problems, *_stamps(inventory), *_calibrations(log), *_stereo(log), *_markers(log), *_picks(log)]
    return Findings(tuple(_usable(log)), tuple(_missing(log)), tuple(odd))


class _Log:
    """A recording seen through the rig's names."""

    def __init__(self, inventory: Inventory, rig: Rig | None) -> None:
        self.inventory = inventory
        self.rig = rig
        self.names = rig if rig is not None else Rig()

    def names_of(self, camera: str) -> Camera:
        return getattr(self.names.cameras, camera)

    def topic(self, name: str | None) -> TopicInventory | None:
        found = self.inventory.topics.get(name or "")
        return found if found is not None and found.messages else None

    def images(self, camera: str) -> TopicInventory | None:
        name = self.names_of(camera).image_topic
        return self.topic(name) or self.topic(f"{name}/compressed") or self.topic(f"{name}/compressedDepth")

    def markers(self, camera: str) -> TopicInventory | None:
        return self.topic(self.names_of(camera).markers_topic)

    def calibration(self, camera: str) -> CameraModel | None:
        found = self.topic(self.names_of(camera).info_topic)
        return found.camera if found is not None else None

    def cloud(self) -> TopicInventory | None:
        return self.topic(self.names.kinect.points_topic)

    def depth_works(self) -> bool:
        images = self.images("b_depth")
        return self.cloud() is not None or (images is not None and self.calibration("b_depth") is not None)

    def stereo_works(self) -> bool:
        return all(self.images(c) and self.calibration(c) is not None for c in ("m_left", "m_right"))

    def sees_markers(self, camera: str) -> bool:
        return self.calibration(camera) is not None and bool(self.images(camera) or self.markers(camera))


def _usable(log: _Log) -> list[str]:
    texts = []
    for camera in ("m_left", "m_right", "b_rgb"):
        if log.sees_markers(camera):
            sources = [topic for topic in (log.images(camera), log.markers(camera)) if topic is not None]
            texts.append(f"marker corners in {camera}: {' and '.join(_counted(topic) for topic in sources)}")
    left, right = log.images("m_left"), log.images("m_right")
    if log.stereo_works() and left is not None and right is not None:
        texts.append(f"stereo visual odometry: {_counted(left)} and {_counted(right)}")
    depth = log.images("b_depth") if log.calibration("b_depth") is not None else None
    if source := depth or log.cloud():
        texts.append(f"Kinect depth cloud: {_counted(source)}")
    points = {pick.point_id: pick.role for _, pick in log.inventory.picks}
    if points:
        names = ", ".join(f"{name} ({role})" for name, role in sorted(points.items()))
        texts.append(f"{len(log.inventory.picks)} picks of {len(points)} points: {names}")
    if log.rig is not None and log.rig.distances:
        texts.append(f"{len(log.rig.distances)} known distances, from the rig")
    if log.rig is not None and log.rig.mount is not None:
        texts.append(f"tape-measured pose of {{b}} in board {log.rig.mount.board}, from the rig")
    truth = [name for name in log.inventory.topics if name.startswith("/truth/")]
    if truth:
        texts.append(f"for evaluation only, never for the estimate: {', '.join(sorted(truth))}")
    return texts


def _missing(log: _Log) -> list[str]:
    texts = []
    if log.rig is None:
        texts.append("a rig: the log carries none (attachment rig.yaml); give --rig (`surecut rig --example`)")
    for camera in ("m_left", "m_right", "b_rgb", "b_depth"):
        data = log.images(camera) or log.markers(camera)
        if data is not None and log.calibration(camera) is None:
            info = log.names_of(camera).info_topic
            texts.append(f"the calibration of {camera}: no usable message on {info}, so {data.topic} cannot be used")
    if not log.sees_markers("m_left"):
        names = log.names_of("m_left")
        texts.append(
            f"the mobile camera: neither images on {names.image_topic} nor markers on {names.markers_topic} "
            "with a calibration; name the recorded topics in the rig"
        )
    if not log.inventory.picks:
        texts.append(f"picks on {log.names.picks_topic}: without one there is no pipe point to estimate")
    if log.rig is not None and not _links_to_b(log):
        texts.append(
            "a link to {b}: no mount in the rig, no Kinect colour image or markers, and no Kinect depth beside stereo"
        )
    return texts


def _links_to_b(log: _Log) -> bool:
    has_mount = log.rig is not None and log.rig.mount is not None
    return has_mount or log.sees_markers("b_rgb") or (log.depth_works() and log.stereo_works())


def _stamps(inventory: Inventory) -> list[str]:
    texts = []
    for topic in inventory.topics.values():
        check = check_stamps(topic.stamps())
        counted = (
            (check.backwards, "stamps run backwards"),
            (check.duplicated, "stamps stand twice"),
            (check.unset, "stamps are not set; such messages cannot be placed in time"),
        )
        if topic.kind != "other":
            texts += [f"{topic.topic}: {number} {text}" for number, text in counted if number]
        if check.gaps and topic.kind in ("image", "depth", "cloud", "markers"):
            texts.append(
                f"{topic.topic}: {check.gaps} gaps, the largest {check.largest_gap_s:.2f} s after "
                f"{check.gap_at_s:.3f} s; the usual step is {1 / (check.rate_hz or 1):.3f} s"
            )
    return texts


def _calibrations(log: _Log) -> list[str]:
    texts = []
    for camera in CAMERAS:
        images, model = log.images(camera), log.calibration(camera)
        info = log.topic(log.names_of(camera).info_topic)
        if images is None or model is None or info is None:
            continue
        if images.size is not None and images.size != (model.width, model.height):
            texts.append(
                f"{info.topic}: the calibration is for {model.width}x{model.height} pixels, the images on "
                f"{images.topic} have {images.size[0]}x{images.size[1]}; record both in one resolution"
            )
        if info.calibration_changes:
            texts.append(f"{info.topic}: the calibration differs from the first in {info.calibration_changes} messages")
    return texts


def _stereo(log: _Log) -> list[str]:
    texts = []
    left, right = log.images("m_left"), log.images("m_right")
    if left is not None and right is not None:
        alone_left, alone_right, apart_ns = unpaired(left.stamps(), right.stamps(), PAIR_TOLERANCE_NS)
        if alone_left or alone_right:
            texts.append(
                f"stereo stamps are unequal: {alone_left} of {left.messages} left and {alone_right} of "
                f"{right.messages} right images have no partner within {PAIR_TOLERANCE_NS / 1e6:g} ms "
                f"(median distance {apart_ns / 1e6:.1f} ms); synchronise the cameras"
            )
    left_model, right_model = log.calibration("m_left"), log.calibration("m_right")
    baseline = right_model.baseline_m if right_model is not None else None
    left_baseline = left_model.baseline_m if left_model is not None else None
    if (baseline is not None and baseline < 0) or (left_baseline is not None and left_baseline > 0):
        shown = baseline if baseline is not None and baseline < 0 else left_baseline
        texts.append(
            f"left and right seem swapped: the baseline in camera_info is {shown:.4f} m at the wrong camera or with "
            "the wrong sign; exchange the topics of m_left and m_right in the rig"
        )
    elif right_model is not None and not baseline and _needs_baseline(log):
        info = log.names_of("m_right").info_topic
        texts.append(f"{info}: no baseline in P[3], and none in the rig (stereo.m_left_T_m_right)")
    return texts


def _needs_baseline(log: _Log) -> bool:
    return log.rig is None or log.rig.stereo.m_left_T_m_right is None


def _markers(log: _Log) -> list[str]:
    if log.rig is None:
        return []
    known = {marker.id for board in log.rig.boards for marker in board.markers}
    texts = []
    for camera in ("m_left", "m_right", "b_rgb"):
        topic = log.markers(camera)
        strange = sorted(set(topic.marker_ids) - known) if topic is not None else []
        if topic is not None and strange:
            names = ", ".join(str(marker) for marker in strange[:8]) + (", ..." if len(strange) > 8 else "")
            texts.append(f"{topic.topic}: markers {names} are on no board of the rig")
    return texts


def _picks(log: _Log) -> list[str]:
    texts = []
    for stamp_ns, pick in log.inventory.picks:
        where = f"{log.names.picks_topic} at {stamp_ns / 1e9:.3f} s: pick of {pick.point_id}"
        if pick.camera not in ("m_left", "m_right", "b_rgb"):
            texts.append(f"{where} on camera {pick.camera!r}, which does not exist; cameras: m_left, m_right, b_rgb")
            continue
        model = log.calibration(pick.camera)
        u, v = pick.px.tolist()
        if model is not None and not (-0.5 <= u < model.width - 0.5 and -0.5 <= v < model.height - 0.5):
            size = f"{model.width}x{model.height}"
            texts.append(f"{where} at ({u:.1f}, {v:.1f}) lies outside the {size} image")
        if pick.role not in ("cut", "grasp", "other"):
            texts.append(f"{where} has role {pick.role!r}; roles: cut, grasp, other")
    return texts


def _counted(topic: TopicInventory) -> str:
    rate = check_stamps(topic.stamps()).rate_hz
    return f"{topic.topic} ({topic.messages}{f', {rate:.1f} Hz' if rate else ''})"
