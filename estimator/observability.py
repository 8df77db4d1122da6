"""What the measurements leave undetermined, in words instead of a solver's numbers."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from ..factors import keys
from ..factors.errors import ObservabilityError
from ..factors.rig import Mount

_MISSING = {
    "x": "record views in which markers or tracked features connect it to the rest",
    "l": "its views have too little parallax; move the camera sideways",
    "q": "see its marker from more places",
    "f": "see the whole board from 1 to 1.5 m, and from two places",
    "h": "see two or more markers of the board, or give its side length a smaller side_sigma_m",
    "b": "give the mount (f_T_b) in the rig file, and see its board with the mobile camera",
    "p": "pick the point again from another place",
    "u": "see the pipe from another side",
    "v": "see the pipe from another side",
    "w": "give the pipe's nominal diameter in the rig file",
    "r": "see both edges of the pipe, or give its nominal diameter in the rig file",
    "k": "give the camera's calibration smaller sigmas in the rig file, or freeze it",
    "e": "give the extrinsics smaller sigmas in the rig file, or freeze them",
    "d": "freeze the depth offset and scale in the rig file",
    "g": "freeze focal and centre of the depth camera in the rig file",
}
_VARIABLE = re.compile(r"near\s+variable\s+(\d+)")


class Undetermined(ObservabilityError):
    """A variable that the factors leave undetermined."""

    def __init__(self, key: int) -> None:
        super().__init__(not_observable(key))
        self.key = key

    def __reduce__(self) -> tuple[type["Undetermined"], tuple[int]]:
        return Undetermined, (self.key,)


@contextmanager
def determined() -> Iterator[None]:
    """Tells a solver's complaint about an indeterminate variable in words.

    Raises:
        Undetermined: names the variable and what is missing.
    """
    try:
        yield
    except RuntimeError as error:
        found = _VARIABLE.search(" ".join(str(error).split()))
        if found is None:
            raise
        raise Undetermined(int(found.group(1))) from error


def not_observable(key: int) -> str:
    """One line about one variable."""
    return f"{keys.words(key)} is not observable from this log; {_MISSING.get(keys.kind(key), 'more views are needed')}"


def why_no_base(mount: Mount | None, board_known: bool) -> str:
    """The missing link between {o} and {b}, in words."""
    if mount is None:
        return (
            "{b} is not observable: the rig has no mount (f_T_b), and Kinect and mobile camera share too few textured "
            "surfaces; add the section `mount` to the rig file, or show both cameras the same things"
        )
    if not board_known:
        return (
            f"{{b}} is not observable: board {mount.board} was never seen well enough by the mobile camera, and Kinect "
            "and mobile camera share too few textured surfaces; record a view of the whole board from 1 to 1.5 m, or "
            "correct the marker ids in the rig file"
        )
    return "{b} is not observable: nothing ties the Kinect to the mobile camera"
