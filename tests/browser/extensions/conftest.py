"""Fixtures of the browser tests of extensions."""

from tests.browser.test_annotate import person

__all__ = ["person"]
