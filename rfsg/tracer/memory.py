"""How much memory a run has taken."""

import sys

import torch

try:
    import resource
except ImportError:  # not on every system
    resource = None


def peak_bytes(device: torch.device | str = "cpu") -> int | None:
    """The most memory in use so far [bytes]: of the device's allocations, or resident in this process
    since it began, libraries included. None where the system does not say."""
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if resource is None:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
