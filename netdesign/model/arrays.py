"""The one door through which arrays enter the frozen values."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def frozen(name: str, value: Any, shape: tuple[int | str, ...], dtype: Any = np.float64) -> NDArray[Any]:
    """Return a read-only copy of ``value`` after its shape has been checked.

    Args:
        name: what the caller calls the array, for the message.
        value: anything ``numpy.array`` takes.
        shape: the expected shape; a string stands for any size, the same string for the same size.
        dtype: element type of the copy.

    Raises:
        ValueError: with the name, the expected and the actual shape.
    """
    array = np.array(value, dtype=dtype)
    sizes: dict[str, int] = {}
    fits = array.ndim == len(shape) and all(
        actual == (sizes.setdefault(wanted, actual) if isinstance(wanted, str) else wanted)
        for actual, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = "(" + ", ".join(str(size) for size in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name}: expected shape {expected}, found {array.shape}")
    array.setflags(write=False)
    return array
