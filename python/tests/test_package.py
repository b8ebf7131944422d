"""The package as a whole: its types, its documentation, its notebook."""

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import b2p

HERE = Path(__file__).parent


def mypy(*words, **environment):
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=HERE, env={**os.environ, **environment})
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_typed_program_passes_the_strict_checker():
    mypy("mypy", "--strict", "--cache-dir", os.devnull, str(HERE / "typed.py"))
    mypy("mypy", "--strict", "--cache-dir", os.devnull, "-p", "b2p")


def test_the_stubs_say_what_the_module_has():
    mypy("mypy.stubtest", "b2p", "--allowlist", str(HERE / "stubtest.txt"))


def test_everything_public_is_documented():
    missing = []
    for name in b2p.__all__:
        thing = getattr(b2p, name)
        if name == "__version__":
            continue
        if not (thing.__doc__ or "").strip():
            missing.append(name)
        for member, value in vars(thing).items() if inspect.isclass(thing) else []:
            is_member = callable(value) or isinstance(value, (property, staticmethod)) or inspect.isdatadescriptor(value)
            if not member.startswith("_") and is_member and not (value.__doc__ or "").strip():
                missing.append(f"{name}.{member}")
    assert not missing


def test_the_notebook_makes_a_picture_of_an_array():
    notebook = json.loads((HERE.parent / "examples" / "first.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert cells and not any(cell["outputs"] for cell in cells)
    space = {}
    for cell in cells:
        exec("".join(cell["source"]), space)
    picture = space["picture"]
    assert picture.dtype == np.uint8 and picture.shape[2] == 3
    assert 0.05 < (picture != 255).any(axis=2).mean() < 0.95
