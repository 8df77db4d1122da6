"""The one place that imports open3d: it takes seconds, and its wheel needs a libusb that a bare machine lacks."""

import ctypes
import importlib
from types import ModuleType

from ..factors.errors import SurecutError


def load_open3d() -> ModuleType:
    """The module `open3d`, with the libusb that its shared library asks for loaded before it.

    Raises:
        SurecutError: open3d or libusb cannot be loaded.
    """
    try:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise SurecutError(
            f"open3d cannot be loaded ({' '.join(str(error).split())}); install surecut with its dependencies again"
        ) from error
