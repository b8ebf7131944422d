"""What the tests share: streams of the repository, clouds, and the program to compare with."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import b2p

ROOT = Path(__file__).resolve().parents[2]
CONFORMANCE = ROOT / "tests" / "data" / "conformance"


@pytest.fixture(scope="session")
def scene():
    """The sample scene: 10 bits, three levels, 50 KB."""
    return (ROOT / "models" / "scene.b2p").read_bytes()


@pytest.fixture(scope="session")
def scene_gaussians(scene):
    return b2p.decode(scene, level=7)


@pytest.fixture(scope="session")
def cloud():
    """Points on a torus, a few thousand, with colours that vary smoothly."""
    return torus(120, 60)


def torus(around, across):
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, around), np.linspace(0, 2 * np.pi, across), indexing="ij")
    u, v = u.ravel(), v.ravel()
    ring = 3 + np.cos(v)
    xyz = np.stack([ring * np.cos(u), ring * np.sin(u), np.sin(v)], axis=1)
    rgb = np.stack([127 + 127 * np.cos(u), 127 + 127 * np.sin(u), 127 + 127 * np.cos(v)], axis=1)
    return xyz, rgb.astype(np.uint8)


@pytest.fixture(scope="session")
def program():
    """Runs the program; without one, the test is skipped."""
    built = os.environ.get("B2P_PROGRAM") or ROOT / "target" / "debug" / "b2p"
    if not Path(built).exists():
        pytest.skip("the program is not built")

    def run(*words):
        done = subprocess.run([built, *map(str, words)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run
