"""Another processor, as far as one machine can play it: older kernels of BLAS, numpy and the C library."""

import os
import platform
import subprocess
import sys

import pytest

SETTINGS = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX,-AVX512F",
}
PROBE = "import numpy as np; a = np.random.default_rng(0).random((9, 9)); print((a @ a @ a).tobytes().hex())"


def _printed(code: str, environment: dict[str, str]) -> str:
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    return done.stdout if done.returncode == 0 else ""


def another_processor() -> dict[str, str]:
    """Environment variables under which linear algebra gives other last bits; skips the test where none does."""
    if platform.machine() != "x86_64":
        pytest.skip("this machine: another processor can be played on x86-64 only")
    other = _printed(PROBE, {**os.environ, **SETTINGS})
    if not other or other == _printed(PROBE, dict(os.environ)):
        pytest.skip("this machine: its linear algebra is that of an older processor already")
    return SETTINGS
