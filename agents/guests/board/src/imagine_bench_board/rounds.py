"""Rounds of a leaderboard: the starts of their tests are secret until the agents are filed.

The board publishes SHA-256 of ``seed:salt``. Until a date, authors file digests of their trained agents. Then seed and
salt are published, and the episodes at the starts of that seed are played by the agents that were filed. That files
were there at their time is shown by the history of the repository in which the board lies.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime
from pathlib import Path

from imagine_bench.errors import ArtefactError, InvalidValueError, brief, require
from imagine_bench.protocols.data import MOST, require_types
from imagine_bench.seeding import SEEDS
from imagine_bench.store.files import make_folder, read_json, reading, sha256, write_json

from .rows import NAME, row_name

ROUNDS = "rounds"
"""The folder of a board that holds its rounds."""
_ROUND = "round.json"
_FILED = "filed"
_REVEALED = "revealed.json"
LONGEST_ROUND = 40
"""Characters of the name of a round: the names of its rows end with it."""
POLICY = "policy"
"""The key of the digest of a policy of continuous control, which is one file; agents of benches have their seeds."""


@dataclass(frozen=True, kw_only=True)
class Round:
    """A round, as it is published first."""

    closes: str  #: The first day on which nothing more is filed, such as 2026-12-24, in UTC
    tests: int  #: Test episodes of each run
    sha256: str  #: Of ``seed:salt``

    def __post_init__(self) -> None:
        require_types(self)
        day_of(self.closes)
        if not 1 <= self.tests <= MOST:
            raise InvalidValueError(f"tests is {brief(self.tests)}; give 1 to {MOST:,}.")


def today() -> date:
    """This day in UTC."""
    return datetime.now(UTC).date()


def day_of(text: str) -> date:
    """A day such as 2026-12-24. Raises InvalidValueError: it is none."""
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise InvalidValueError(f"{brief(text)} is no day; write it as 2026-12-24.") from None


def promise(seed: int, salt: str) -> str:
    """The digest that binds a seed before it is published; the salt keeps others from trying all seeds."""
    return hashlib.sha256(f"{seed}:{salt}".encode()).hexdigest()


def open_round(folder: Path, *, closes: str, tests: int, secret: Path) -> str:
    """Draw a seed and a salt into the file ``secret``, and publish their digest in a new folder of a round.

    Raises InvalidValueError: the day has begun, or one of the two exists.
    """
    if day_of(closes) <= today():
        raise InvalidValueError(f"{closes} is not after today, {today()}; give a later day to --closes.")
    for path in (folder, secret):
        if path.exists():
            raise InvalidValueError(f"{path} exists; give another.")
    if not NAME.fullmatch(folder.name) or len(folder.name) > LONGEST_ROUND:
        allowed = f"at most {LONGEST_ROUND} of a-z, 0-9 and _.,=-"
        raise InvalidValueError(f"A round cannot be called {brief(folder.name)}; give {allowed}.")
    seed = secrets.randbelow(SEEDS)
    salt = secrets.token_hex(32)
    found = Round(closes=closes, tests=tests, sha256=promise(seed, salt))
    write_json(secret, {"seed": seed, "salt": salt})
    write_json(make_folder(folder) / _ROUND, asdict(found))
    return f"{folder / _ROUND} is to be published. Keep {secret} secret until {closes}."


def read_round(folder: Path) -> Round:
    """A round. Raises ArtefactError: there is none."""
    values = read_json(folder / _ROUND, "a round of a board")
    with reading(folder / _ROUND, "a round of a board"):
        return Round(**values)


def file_agents(folder: Path, row: str, agents: Mapping[int, str] | Mapping[str, str]) -> Path:
    """File the digests of a row's agents, by seed, or of its policy's file, as :data:`POLICY`.

    Raises InvalidValueError: the round is closed, or they are filed.
    """
    closes = read_round(folder).closes
    if today() >= day_of(closes):
        raise InvalidValueError(f"The round {folder.name} closed on {closes}; file in a later one.")
    path = make_folder(folder / _FILED) / f"{row}.json"
    if path.exists():
        raise InvalidValueError(f"{path} exists: these agents are filed already.")
    write_json(path, {str(seed): digest for seed, digest in agents.items()})
    return path


def policy_row(folder: Path, policy: Path) -> str:
    """The name of the row of a policy's file in a round: that of the file without its ending, and the round's."""
    return row_name(policy.stem, folder.name)


def reveal(folder: Path, secret: Path) -> str:
    """Publish seed and salt, with the digests of all that was filed. Raises InvalidValueError: it is too early.

    Raises ArtefactError: the secret is not that of the round.
    """
    found = read_round(folder)
    if today() < day_of(found.closes):
        raise InvalidValueError(f"The round {folder.name} closes on {found.closes}; reveal its seed from then on.")
    values = read_json(secret, "the secret of a round")
    with reading(secret, "the secret of a round"):
        require(promise(values["seed"], values["salt"]) == found.sha256, f"{secret} is not of {folder.name}.")
    filed = {path.stem: sha256(path) for path in sorted((folder / _FILED).glob("*.json"))}
    write_json(folder / _REVEALED, {**values, "filed": filed})
    return f"The seed of {folder.name} is {values['seed']}; {len(filed)} filed rows may be submitted now."


def revealed_seed(folder: Path, row: str) -> tuple[int, Mapping[str, str]]:
    """The published seed of a round, and the digests of a row's agents that were filed before.

    Raises ArtefactError: the seed is not published or not the promised one, or the row was not filed in time.
    """
    found = read_round(folder)
    values = read_json(folder / _REVEALED, f"the published seed of the round {folder.name}")
    path = folder / _FILED / f"{row}.json"
    with reading(folder / _REVEALED, "the published seed of a round"):
        kept = promise(values["seed"], values["salt"]) == found.sha256
        require(kept, f"the seed of the round {folder.name} is not the one that was promised.")
        seed = int(values["seed"])
        filed = values["filed"].get(row)
    if filed is None:
        raise ArtefactError(f"it was not filed in the round {folder.name} before its seed was published.")
    require(sha256(path) == filed, f"{path.name} was changed after the seed of the round was published.")
    agents = read_json(path, "the filed agents of a row")
    return seed, {str(name): str(digest) for name, digest in agents.items()}
