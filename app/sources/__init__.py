"""Sources of records: what may be opened and how. This package adds the formats of the extensions to those of
the library; each process of the program that opens files imports it."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

from app.extension import all_extensions, switched_off
from pipeline.io.readers import add_formats

if TYPE_CHECKING:
    from pipeline.io.readers import AnyFormat

_log = logging.getLogger(__name__)


def _formats_of_extensions() -> list[AnyFormat]:
    """Return the formats of the extensions; those of extensions that are switched off refuse their files.
    Those of an extension that fails to name them are left out, and this is logged."""
    found: list[AnyFormat] = []
    for each in sorted(all_extensions(), key=lambda each: not each.is_on):  # those that refuse come last
        if each.extension is None or each.extension.formats is None:
            continue
        try:
            for kind in each.extension.formats():
                found.append(kind if each.is_on else replace(kind, refusal=switched_off(each.name)))
        except Exception:  # the code of others: other files can be opened without it
            if each.is_on:
                _log.exception("the formats of the extension %s are left out", each.name)
    return found


add_formats(_formats_of_extensions)
