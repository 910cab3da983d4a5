"""The seal of a result.json: a hash of what casacal wrote, by which an edit by hand is noticed.

It names the keys that it is of: all that were written but the seconds, which differ from run to run. Keys that somebody
adds later are no part of it and break nothing; whatever a verdict, a weight or a figure rests on is. It guards against
slips and wishes, not against a forger: who knows how can seal anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from casacal.errors import CasacalError
from casacal.files import jsonable

FREE = ("seal", "seconds")
"""Keys that are not sealed."""

FIX = "Restore it, or calibrate again"


def sealed(document: Mapping[str, Any]) -> dict[str, Any]:
    """The document with its seal, made anew where it has one."""
    keys = sorted(key for key in document if key not in FREE)
    kept = {key: item for key, item in document.items() if key != "seal"}
    return {**kept, "seal": {"of": keys, "sha256": _digest(jsonable(kept), keys)}}


def check_seal(file: str, document: Mapping[str, Any]) -> None:
    """Raise CasacalError unless a document, as read from its file, is what was sealed."""
    seal = document.get("seal")
    if not isinstance(seal, dict) or not isinstance(seal.get("of"), list):
        raise CasacalError(f"{file}: its seal is gone, so it was changed after it was written", FIX)
    keys = seal["of"]
    try:
        same = all(isinstance(key, str) for key in keys) and seal.get("sha256") == _digest(document, keys)
    except (ValueError, RecursionError):
        same = False
    if not same:
        raise CasacalError(f"{file}: it was changed after it was written", FIX)


def _digest(document: Mapping[str, Any], keys: Sequence[str]) -> str:
    """Hash of the list of keys and of what stands there, as JSON with sorted keys and without spaces."""
    told = [list(keys), {key: document[key] for key in keys if key in document}]
    return hashlib.sha256(json.dumps(told, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
