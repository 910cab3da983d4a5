"""Results sealed anew after an edit, so that what looks behind the seal is tested too; written apart from casacal's."""

import hashlib
import json


def resealed(document):
    """A copy that claims to be as it was written: what somebody who knows how may write."""
    keys = sorted(document.keys() - {"seal", "seconds", "written_by"})
    text = json.dumps([keys, {key: document[key] for key in keys}], sort_keys=True, separators=(",", ":"))
    return {**document, "seal": {"of": keys, "sha256": hashlib.sha256(text.encode()).hexdigest()}}


def resealed_text(text):
    """The same of a file's bytes; these themselves where they hold no document."""
    try:
        document = json.loads(text)
        return json.dumps(resealed(document)).encode() if isinstance(document, dict) else text
    except (ValueError, RecursionError):
        return text
