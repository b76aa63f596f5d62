"""Numbers in the place of nodes, for what is made to leave the machine: trials name nodes of a cluster.

A record has `ADDRESS/ID` of the node that a trial ran on last; notes and errors name nodes in sentences.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from analysis.records import TrialRecord

_NAMED = re.compile(r"\bNode (\S+) \((?:[^\s()]+, node )?([0-9a-f]{8})\)")
"""A node in a sentence, such as "Node 10.1.2.7 (1f2e3d4c) was lost."; before the id there may be the host's name."""


class NumberedNodes:
    """The nodes of a sweep, numbered in the order in which its trials name them.

    Args:
        trials: The sweep's trials, in order.
    """

    def __init__(self, trials: Sequence[TrialRecord]) -> None:
        self._numbers: dict[str, int] = {}
        for trial in trials:
            if trial.node is not None:
                self._number(trial.node)
        for trial in trials:
            # It went on elsewhere since, or never ran there.
            for address, node_id in _NAMED.findall("\n".join([*trial.notes, trial.error or ""])):
                self._number(f"{address}/{node_id}")
        self._by_address: dict[str, int] = {}
        for node, number in self._numbers.items():
            address = node.partition("/")[0]
            # A word may mean something else, and this machine's own address is the same on every machine.
            if re.search("[.:]", address) and not address.startswith("127."):
                self._by_address.setdefault(address, number)
        known = "|".join(re.escape(address) for address in sorted(self._by_address, key=len, reverse=True))
        # No part of a longer address; a port may follow, or the end of a sentence.
        pattern = rf"(?P<begins>\bNode )?(?<![\w.-])(?P<address>{known})(?![\w-]|\.\w)"
        self._addresses = re.compile(pattern) if known else None

    def _number(self, node: str) -> int:
        return self._numbers.setdefault(node, len(self._numbers) + 1)

    def named(self, node: str) -> str:
        """Return a node's number, as a name."""
        return f"node {self._number(node)}"

    def in_text(self, text: str) -> str:
        """Return a text with numbers in the place of nodes."""
        text = _NAMED.sub(lambda found: f"Node {self._number(f'{found[1]}/{found[2]}')}", text)
        if self._addresses is None:
            return text
        return self._addresses.sub(
            lambda found: f"{found['begins'] or 'node '}{self._by_address[found['address']]}", text
        )
