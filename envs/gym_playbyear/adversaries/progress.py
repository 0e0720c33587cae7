"""What a check has played so far, in a file, so that one that was stopped goes on with the next player."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gym_playbyear.adversaries.scripts import Outcome


class Progress:
    """Finished players' attempts.

    Args:
        path: Of the file; None: nothing is kept.
        settings: Task, options and seeds. What was played with others is forgotten.
    """

    def __init__(self, path: Path | None, settings: dict[str, Any]):
        self.path, self.settings = path, json.loads(json.dumps(settings))
        self._played: dict[str, list[dict[str, Any]]] = {}
        if path is not None and path.exists():
            kept = json.loads(path.read_text())
            if kept["settings"] == self.settings:
                self._played = kept["played"]
                if self._played:
                    print(
                        f"{path} has {', '.join(self._played)} of a check that was stopped: they do not play again. Remove it "
                        "if the task has changed since.",
                        file=sys.stderr,
                    )

    def attempts(self, player: str) -> list[Outcome] | None:
        """How a player's attempts ended; None if it has not played yet."""
        kept = self._played.get(player)
        return None if kept is None else [Outcome(**attempt) for attempt in kept]

    def keep(self, player: str, attempts: list[Outcome]) -> None:
        """Writes a player's attempts down."""
        self._played[player] = [asdict(attempt) for attempt in attempts]
        if self.path is not None:
            new = self.path.with_suffix(".new")
            new.write_text(json.dumps({"settings": self.settings, "played": self._played}))
            new.replace(self.path)
