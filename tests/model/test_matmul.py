"""The choice of a matmul route: exact enough for what was asked, and without a trace until applied."""

import subprocess
import sys

import pytest
import torch

from preface.model.matmul import FP32_ERROR, Route, choose_route, measure_route


@pytest.fixture(autouse=True)
def _route_as_before():
    before = torch.backends.mkldnn.matmul.fp32_precision
    yield
    torch.backends.mkldnn.matmul.fp32_precision = before


def off(width: int) -> float:
    a, b = torch.randn(256, width), torch.randn(width, 64)
    exact = a.double() @ b.double()
    return float(((a @ b) - exact).abs().max() / exact.abs().max())


def test_a_float32_route_multiplies_in_float32() -> None:
    before = torch.backends.mkldnn.matmul.fp32_precision
    route = choose_route("fp32", width=128)
    assert torch.backends.mkldnn.matmul.fp32_precision == before
    assert route.name in ("mkl", "onednn")
    assert 0 < route.error <= FP32_ERROR
    assert route.gflops > 0
    route.apply()
    assert all(off(width) <= FP32_ERROR for width in (1, 3, 64, 420, 1000))


def test_a_route_that_rounds_to_bfloat16_is_seen_as_such() -> None:
    """Either the processor has no such products and the route is exact, or it has and the error says so."""
    error = measure_route("onednn", width=128).error
    assert error <= FP32_ERROR or error > 1e-4
    if error > FP32_ERROR:
        assert choose_route("fp32", width=128).name == "mkl"


def test_bfloat16_states_its_error() -> None:
    route = choose_route("bf16", width=128)
    assert route.name == "bfloat16"
    assert 1e-4 < route.error < 1e-2


def test_applying_mkl_undoes_onednn() -> None:
    Route("onednn", 1.0, 0.0).apply()
    Route("mkl", 1.0, 0.0).apply()
    assert off(256) <= FP32_ERROR


def page_faults(keep: bool) -> int:
    """Of a process that allocates and frees 32 MiB time after time; of its own, since it cannot be undone."""
    code = (
        "import resource, torch\n"
        "from preface.model.matmul import keep_freed_memory\n"
        f"kept = keep_freed_memory() if {keep} else True\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "for _ in range(16):\n"
        "    torch.ones(1 << 23)\n"
        "faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before\n"
        "print(faults if kept else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_memory_that_was_freed_is_used_again() -> None:
    assert page_faults(keep=True) < 0.8 * page_faults(keep=False)
