"""The unit of a study's work: all methods of one trial, which see the same arm, touches and noise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from casacal.study.records import Key


@dataclass(frozen=True)
class Task:
    """Some methods in one trial of a setting, and the key of each."""

    setting: str
    trial: int
    methods: tuple[str, ...]
    fingerprints: tuple[str, ...]

    @property
    def keys(self) -> list[Key]:
        """Key of each record that the task makes."""
        return [(fingerprint, self.trial) for fingerprint in self.fingerprints]

    def without(self, done: Iterable[Key]) -> Task:
        """The task without the methods that are recorded already."""
        kept = [i for i, key in enumerate(self.keys) if key not in set(done)]
        return replace(
            self,
            methods=tuple(self.methods[i] for i in kept),
            fingerprints=tuple(self.fingerprints[i] for i in kept),
        )
