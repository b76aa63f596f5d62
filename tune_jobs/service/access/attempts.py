"""How often something may be tried, such as showing a token that is none."""

from __future__ import annotations

import ipaddress
import threading
import time
from collections import deque
from collections.abc import Callable


class RateLimit:
    """Counts attempts by key, such as a client's address; threads may share one.

    Args:
        limit: How many there may be in `window_s`.
        window_s: In seconds.
        clock: Returns a monotonic time in seconds.
    """

    MAX_KEYS = 10_000

    def __init__(self, limit: int = 10, window_s: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._limit, self._window_s, self._clock = limit, window_s, clock
        self._attempts: dict[str, deque[float]] = {}
        self._lock = threading.Lock()

    def begin(self, key: str) -> float:
        """Count an attempt and return 0; where there were too many, return how long to wait instead, in seconds.

        It counts before it is known how it ends, so that many that come at once are within the limit, too.
        """
        now = self._clock()
        with self._lock:
            attempts = self._attempts.pop(key, None) or deque()
            while attempts and attempts[0] <= now - self._window_s:
                attempts.popleft()
            wait_s = attempts[0] + self._window_s - now if len(attempts) >= self._limit else 0.0
            if not wait_s:
                attempts.append(now)
            # The last that came is last in the dictionary: who has not come for long goes first.
            self._attempts[key] = attempts
            while len(self._attempts) > self.MAX_KEYS:
                del self._attempts[next(iter(self._attempts))]
            return wait_s

    def forgive(self, key: str) -> None:
        """Take back the last attempt."""
        with self._lock:
            attempts = self._attempts.get(key)
            if attempts:
                attempts.pop()
                if not attempts:
                    del self._attempts[key]


def network_of(client: str) -> str:
    """Return what one person has of addresses: of version 6 they have 2^64."""
    try:
        address = ipaddress.ip_address(client)
    except ValueError:
        return client
    if isinstance(address, ipaddress.IPv6Address):
        # A socket for both versions shows those of version 4 as such.
        mapped = address.ipv4_mapped
        return str(ipaddress.ip_network((address, 64), strict=False)) if mapped is None else str(mapped)
    return str(address)
