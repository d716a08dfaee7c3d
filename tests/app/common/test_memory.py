"""Memory that threads have freed is returned to the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

_PROGRAM = """
import threading
from pathlib import Path
import numpy as np
from app.common.memory import return_freed_memory

def resident_mib():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024

def work(kept):
    arrays = [np.ones(k << 17) for k in range(1, 16)]  # 1 to 15 MiB, and small ones between them
    kept.extend(np.ones(100) for _ in arrays)

return_freed_memory()
kept, before = [], resident_mib()
for _ in range(4):
    threads = [threading.Thread(target=work, args=(kept,)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
print(resident_mib() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc has mallopt")
def test_arrays_that_threads_have_freed_take_no_memory():
    told = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    assert float(told.stdout) < 30.0
