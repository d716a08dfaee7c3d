"""Saving: records of the pipeline in a file, without a pickle, with every size checked."""

from pipeline.io.checkpoints.archive import read_archive, write_archive
from pipeline.io.checkpoints.codec import decode, encode

__all__ = ["decode", "encode", "read_archive", "write_archive"]
