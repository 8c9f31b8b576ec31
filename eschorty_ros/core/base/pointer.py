"""The address of a compiled function, as an argument of others.

A kernel becomes machine code in each entry kernel that uses it; one that is called by its address
becomes so once.
"""

from __future__ import annotations

from typing import Any

from numba import typeof, types


class Pointer(types.WrapperAddressProtocol):
    """Address of an `entry_kernel`, for arguments of the types of these.

    Where the function raises, this is reported as unraisable, and it returns zero or ``False``.
    """

    def __init__(self, function: Any, *arguments: Any) -> None:
        given = tuple(map(typeof, arguments))
        function.compile(given)
        compiled = function.overloads[given]
        self._signature = compiled.signature
        name = compiled.fndesc.llvm_cfunc_wrapper_name
        self._address = compiled.library.get_pointer_to_function(name)

    def __wrapper_address__(self) -> int:
        return int(self._address)

    def signature(self) -> Any:
        """Return the types of the arguments and of the result."""
        return self._signature
