"""Tensors as plain arrays, where a result leaves torch: files, tables, pictures."""

from typing import Any

import numpy as np


def array(value: Any) -> np.ndarray:
    """A tensor's numbers, out of the graph and on the processor; arrays and lists as they are."""
    return value.detach().cpu().numpy() if hasattr(value, "detach") else np.asarray(value)
