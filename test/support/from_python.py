"""Calls of kernels that otherwise only kernels call."""

from numba import njit


def from_python(kernel):
    """Return a function that Python can call as ``kernel`` is called."""

    @njit
    def call(*arguments):
        return kernel(*arguments)

    return call
