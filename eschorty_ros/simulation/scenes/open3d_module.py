"""The optional Open3D, loaded when a mesh or a window needs it."""

from __future__ import annotations

import contextlib
import ctypes
from types import ModuleType

from eschorty_ros.core.base.errors import EschortyError

# Debian's packages of the libraries that Open3D links and that a bare machine lacks.
_LIBRARIES = "libegl1 libgl1 libx11-6"


def load_open3d(purpose: str) -> ModuleType:
    """Return the module ``open3d``; the message of an error names ``purpose``, which needs it.

    Raises ``EschortyError`` when it does not import.
    """
    with contextlib.suppress(ImportError, OSError):
        # Open3D links libusb-1.0, which a bare machine lacks; this package contains one.
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    try:
        import open3d
    except (ImportError, OSError) as error:
        # Compiled modules turn the exception of a signal into an ImportError.
        if isinstance(error.__cause__, KeyboardInterrupt | SystemExit):
            raise error.__cause__ from None
        absent = isinstance(error, ModuleNotFoundError)
        remedy = "pip install open3d libusb-package" if absent else f"apt install {_LIBRARIES}"
        raise EschortyError(
            f"{purpose} needs open3d, which does not import here ({error}); run: {remedy}"
        ) from error
    module: ModuleType = open3d
    return module
