"""What a result says of itself where it may be used: its verdict, and the words that its users must not be without."""

from __future__ import annotations

from casacal.compensation.arm import CalibratedArm


def verdict_part(result: CalibratedArm) -> dict[str, str] | None:
    """The verdict on a result as {level, words}; None for a truth, and for a result from before there were verdicts."""
    verdict = result.document.get("verdict")
    return None if not verdict else {"level": str(verdict["level"]), "words": str(verdict["words"])}


def caution(result: CalibratedArm) -> str | None:
    """The words of a verdict to use a result with care; None for any other."""
    verdict = verdict_part(result)
    return verdict["words"] if verdict is not None and verdict["level"] == "use with care" else None
