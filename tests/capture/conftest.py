"""Makes the simulated scenes of the benchmark importable, and calibrates a small one once for all tests."""

import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).resolve().parents[2] / "tools" / "bench"
if str(BENCH) not in sys.path:
    sys.path.insert(0, str(BENCH))


@pytest.fixture(scope="session")
def small_scene():
    """Three cameras, fourteen board poses, 2% outliers; 640x960 pixels, no distortion."""
    from calibration_scene import SceneConfig, simulate

    config = SceneConfig(
        cameras=3,
        frames=14,
        azimuth=25,
        width=640,
        height=960,
        focal=2000,
        outliers=0.02,
        distortion=(0, 0, 0, 0),
    )
    return simulate(config, seed=1)


@pytest.fixture(scope="session")
def small_calibration(small_scene):
    """Its calibration, camera model and board as they are."""
    from preface.capture.calibration import CalibrationOptions, calibrate_rig

    return calibrate_rig(small_scene.observations, CalibrationOptions("PINHOLE", "off"))
