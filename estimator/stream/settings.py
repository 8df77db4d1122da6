"""What the streaming process may hold, and how long it waits."""

from dataclasses import dataclass, field

from ..limits import Limits

MS = 1_000_000
S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """Bounds and periods. Times are of stamps, or of receipt where that is said."""

    window_ns: int = 100 * MS
    """How long an image waits, by receipt, for others of its moment or of earlier ones that are missing."""
    queue_count: int = 400
    queue_bytes: int = 256 << 20
    """Between the receiving threads and the ordering: the oldest messages beyond are dropped and counted."""
    tracking_ahead: int = 4
    """Groups of messages that are handed to the tracking at a time: newer ones wait where they can be dropped."""
    looking_ahead: int = 100
    """Groups that the other front ends may be behind the tracking."""
    graph_ahead: int = 200
    """Stamps that the graph may be behind the front ends."""
    thin_from: int = 40
    """Stamps behind from which on the graph gets fewer frames."""
    thin_ns: int = 500 * MS
    """Between keyframes that it gets then."""
    recent_ns: int = 15 * S
    """How far back a click may be: pictures of so long are kept."""
    answer_period_ns: int = 400 * MS
    """Points in {b} with covariance at least so often, while measurements come."""
    glance_period_ns: int = 400 * MS
    """Between looks at the boards while there are no keyframes: a knock is to be told within two seconds."""
    audit_period_ns: int = 20 * S
    """Between tests of the model against its own data."""
    checkpoint_period_s: float = 5.0
    """By the computer's clock."""
    image_period_ns: int = 200 * MS
    """Between images for people."""
    silence_ns: int = 1 * S
    """By receipt: a topic that came and comes no more is missing."""
    frozen_frames: int = 10
    """Identical images under new stamps: the camera repeats itself. Half a second at 20 Hz."""
    clock_jump_ns: int = 500 * MS
    """Change of stamp less receipt within one message."""
    unpaired_share: float = 0.5
    """Share of the last images without a partner from which the pair's stamps are apart."""
    drift_sigma: float = 4.0
    """Departure of a calibration from its prior, in sigmas of the prior, that is told."""
    unseen_walk_m_per_root_s: float = 0.0005
    unseen_turn_rad_per_root_s: float = 0.0002
    """Random walk of the machine against the last view of a board or of mapped places, while nobody looks. An
    agreement, not a measurement: after two minutes it is 5 mm and 2 mrad."""
    limits: Limits = field(default_factory=Limits)
