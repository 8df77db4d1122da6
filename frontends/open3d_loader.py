"""The one place that imports open3d: it takes two seconds and wants libusb, which bare machines lack."""

import ctypes
from types import ModuleType

import libusb_package


def load_open3d() -> ModuleType:
    """open3d, after the libusb of the `libusb_package` wheel has been loaded for it.

    Call it inside functions that process clouds, never at import time.
    """
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
