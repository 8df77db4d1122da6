"""How much of its past an engine keeps that runs without end."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Limits:
    """How much of the past stays as it was measured."""

    keyframes: int = 60
    """Keyframes in the graph, at most; a recording of half a minute makes about 30."""
    step: int = 20
    """Keyframes that leave together: the more, the more rarely the solver begins anew."""
    map_landmarks: int = 60
    """Landmarks of keyframes that left which stay, so that places that are seen again hold the camera."""
    shared_landmarks: int = 40
    """Landmarks seen on both sides of the cut that go on holding the camera to its past. Each one more makes the prior
    larger, and it is dense. The others are taken for two points, one on each side: that only leaves something out."""
    told: int = 1000
    """Refused measurements and events that are kept with their words; all are counted."""
    frames: int = 2000
    """Frames of the trajectory that are kept."""

    def __post_init__(self) -> None:
        if not 0 < self.step < self.keyframes:
            raise ValueError(f"step {self.step} is not between 0 and keyframes {self.keyframes}")
