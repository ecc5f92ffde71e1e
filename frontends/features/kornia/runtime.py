"""torch's device, its threads, and which numpy arrays have a copy on the device."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from threading import RLock

import numpy as np
import torch
from numpy.typing import NDArray

from dualslam.core.errors import ConfigError

_ON_CPU = RLock()


def choose_device(name: str) -> torch.device:
    """Return the device that the config names; `auto` is CUDA where torch sees it.

    Raises
    ------
    ConfigError
        CUDA is asked for and torch sees none.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"frontend.options.device: torch {torch.__version__} sees no CUDA device: install a torch built for CUDA, "
            "or choose cpu or auto"
        )
    return torch.device(name)


@contextmanager
def inference(device: torch.device, half: bool) -> Iterator[None]:
    """Run torch without gradients; on the CPU in one thread, on CUDA the networks in half precision if wanted.

    The number of threads belongs to the process: it is put back. One, because the order of a sum, and so its last bit,
    would depend on it, and because our parallelism is processes (`dualslam.core.threads`). Callers in other threads
    wait: they would put back each other's.
    """
    on_cpu = device.type == "cpu"
    with _ON_CPU if on_cpu else nullcontext():
        threads = torch.get_num_threads()
        if on_cpu:
            torch.set_num_threads(1)
        try:
            with torch.inference_mode(), torch.autocast(device.type, torch.float16, enabled=half and not on_cpu):
                yield
        finally:
            if on_cpu:
                torch.set_num_threads(threads)


class DeviceCopies:
    """Arrays that came from the device and are still there, so that matching need not send them back.

    An array is known by its identity and held weakly: its copy goes when it does. The result of a search is the same
    with and without the copy.

    Parameters
    ----------
    device : torch.device
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._copies: dict[int, tuple[weakref.ref[NDArray[np.float32]], torch.Tensor]] = {}

    def __len__(self) -> int:
        return len(self._copies)

    def to_host(self, tensor: torch.Tensor) -> NDArray[np.float32]:
        """Return a float32 tensor as an array and remember where it came from."""
        array: NDArray[np.float32] = tensor.float().cpu().numpy()
        if self._device.type != "cpu":
            self.remember(array, tensor.float())
        return array

    def remember(self, array: NDArray[np.float32], tensor: torch.Tensor) -> None:
        """Keep the tensor for as long as the array lives."""
        key, copies = id(array), self._copies
        self._copies[key] = (weakref.ref(array, lambda _: copies.pop(key, None)), tensor)

    def to_device(self, array: NDArray[np.generic]) -> torch.Tensor:
        """Return the array on the device as float32: its copy where it has one; on the CPU it shares memory."""
        known = self._copies.get(id(array))
        if known is not None and known[0]() is array:
            return known[1]
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self._device)
