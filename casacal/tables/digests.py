"""SHA-256 of what several threads read."""

from __future__ import annotations

import hashlib
from collections import deque
from threading import Lock


class SharedDigest:
    """SHA-256 of bytes in their order, by whichever thread has time: none is kept for it that would wait for another's.

    As many threads as processors then do all work.
    """

    def __init__(self, first: bytes) -> None:
        self._sha, self._waiting, self._busy = hashlib.sha256(first), deque[bytes](), Lock()

    def add(self, data: bytes) -> None:
        """What comes next, to be dealt with some time."""
        self._waiting.append(data)

    def go_on(self) -> None:
        """Deal with all that waits, unless another thread does."""
        if self._busy.acquire(blocking=False):
            try:
                while self._waiting:
                    self._sha.update(self._waiting.popleft())
            finally:
                self._busy.release()

    def all(self) -> str:
        """The digest of all that was added, once no thread is at work."""
        self.go_on()
        return self._sha.hexdigest()
