"""Checkpoints: records of the pipeline in files, without pickle, and with all sizes checked."""

from pipeline.io.checkpoints.codec import decode, encode, read_archive, record_bytes, record_of, write_archive

__all__ = ["decode", "encode", "read_archive", "record_bytes", "record_of", "write_archive"]
