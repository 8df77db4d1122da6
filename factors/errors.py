"""The one exception root: an error that a user can mend is told in one line, everything else is a defect."""


class SurecutError(Exception):
    """An input cannot give an answer. The message is one line: what, where, when, and the cure."""


class RigError(SurecutError):
    """The rig file contradicts itself or the recording."""


class LogError(SurecutError):
    """A recording cannot be read, or lacks what the estimate needs."""


class ObservabilityError(SurecutError):
    """The measurements do not determine what was asked for; says which link is missing."""
