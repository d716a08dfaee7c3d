"""Reads damaged copies of one file, one line of JSON for each: `python -m tests.benchmarks.fuzzing`."""

from __future__ import annotations

import json
import sys
import time
import traceback
import zlib
from pathlib import Path

from tests.benchmarks.machine import peak_mib
from tests.benchmarks.mutating import mutation
from tests.benchmarks.real_files import AFTERWARDS, KINDS, real_file


def main(kind: str, data: Path, folder: Path, first: int, last: int) -> None:
    """Read the copies from `first` to before `last`."""
    name, read = KINDS[kind]
    original = real_file(kind, data, folder)
    damaged = folder / name
    seed, afterwards = zlib.crc32(kind.encode()), AFTERWARDS.get(kind, bytes)
    damaged.write_bytes(original)
    said = read(damaged)
    if said:
        raise SystemExit(f"the file itself cannot be read: {said}")
    for number in range(first, last):
        damaged.write_bytes(afterwards(mutation(original, seed, number)))
        begun, fault = time.process_time(), ""
        try:
            refused = read(damaged) != ""
        except Exception:
            refused, fault = False, traceback.format_exc()
        told = [number, refused, time.process_time() - begun, peak_mib(), fault]
        print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))
