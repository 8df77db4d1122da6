"""The mount as somebody else might have measured it."""

import numpy as np
from numpy.typing import NDArray

from ..factors.errors import RigError
from ..factors.rig import Rig
from .faults import pose_section
from .rigid import rigid


def with_mount_anew(rig: Rig, f_T_b: NDArray[np.float64], seed: int) -> Rig:
    """The same rig with another mount, drawn about the true one with the tolerance that the rig states.

    Pixels do not depend on what a rig says, so that one recording serves for many measurements of its mount.

    Args:
        rig: has a mount.
        f_T_b: the true one, shape (4, 4).
        seed: of the draw.

    Raises:
        RigError: it has none.
    """
    if rig.mount is None:
        raise RigError("the rig has no mount that could be drawn anew")
    rng = np.random.default_rng(seed)
    stated = f_T_b @ rigid(rng.normal(0, rig.mount.rotation_sigma_rad, 3))
    stated[:3, 3] += rng.normal(0, rig.mount.translation_sigma_m, 3)
    return rig.model_copy(update={"mount": rig.mount.model_copy(update={"f_T_b": pose_section(stated)})})
