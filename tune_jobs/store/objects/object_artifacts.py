"""A sweep's results in an object store: winner, films and report; see `contract.Sweep`.

They are made in a folder of this process, and fetched into one that this machine's processes share, so that paths which
users are told stay.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel

from analysis.best_records import BestRecord, FilmsRecord
from policies.errors import CannotRunError, CheckpointError, NotFoundError
from policies.files import atomic_path
from policies.portable.file import PortablePolicy, save_policy
from tune_jobs.store import names
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.objects.at_once import side_by_side
from tune_jobs.store.objects.bucket import Listed, Tag
from tune_jobs.store.objects.parts import Parts
from tune_jobs.store.objects.scratch import filling, make_local, write_local
from tune_jobs.store.record_files import dump_sealed


class Artifacts(ABC):
    """What a sweep has come to; the part of `ObjectSweep` that has it.

    Args:
        parts: The sweep's objects.
    """

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._bucket = parts.bucket

    @abstractmethod
    def check_not_removed(self) -> None:
        """Check that the sweep is one still, before anything is written of it.

        Raises:
            NotFoundError: It was removed.
        """

    def _shared(self, folder: str, *, fetched: bool = True) -> Path:
        """Return the local folder of the winner or the report, with what the store has of it."""
        local = self._parts.shared() / folder
        make_local(local)
        if fetched:
            listed = self._parts.listed(f"{folder}/").items()
            present = {key.removeprefix(f"{folder}/"): item for key, item in listed}
            stale = [name for name, item in present.items() if _differs(local / name, item)]
            side_by_side(lambda name: self._fetch(folder, name, present[name]), stale)
            for path in [path for path in local.rglob("*") if path.is_file()]:
                name = path.relative_to(local).as_posix()
                if name not in present and not path.name.startswith("."):
                    path.unlink(missing_ok=True)
        return local

    def _fetch(self, folder: str, name: str, item: Listed) -> None:
        path = self._parts.shared() / folder / name
        if self._bucket.fetch(f"{folder}/{name}", path):
            _mark(path, item.tag)

    def _upload(self, folder: str, made: Path, paths: Sequence[Path]) -> None:
        """Upload files that were made, and have them where they are looked for, so that none has to be fetched."""
        keys = {f"{folder}/{path.relative_to(made).as_posix()}": path for path in paths}
        tags = self._parts.put_files(keys)
        for key, path in keys.items():
            self._keep(key, path, tags[key])

    def _keep(self, key: str, made: Path, tag: Tag) -> None:
        # Where it cannot be kept, it is fetched when it is looked for, which says why.
        with contextlib.suppress(OSError, CannotRunError):
            local = self._parts.shared() / key
            with atomic_path(local) as temporary:
                shutil.copyfile(made, temporary)
            _mark(local, tag)

    def _write_record(self, name: str, record: BaseModel) -> None:
        """Write a record of the winner, and have it where its files are looked for, too."""
        key, text = f"{names.BEST_FOLDER}/{name}", dump_sealed(record)
        self._parts.write_record(key, text)
        made = self._parts.own() / "made" / name
        write_local(made, text)
        self._keep(key, made, self._parts.tag_of(key))

    def has_best(self) -> bool:
        """Whether a winner has been written."""
        return self._parts.fetch_record(f"{names.BEST_FOLDER}/{names.BEST_RECORD}") is not None

    def read_best(self) -> BestRecord:
        """Read the winner's record."""
        key = f"{names.BEST_FOLDER}/{names.BEST_RECORD}"
        try:
            return self._parts.read_record(key, BestRecord, "best record", is_sealed=True)
        except CheckpointError:
            raise
        except NotFoundError as error:
            raise NotFoundError(
                f"Sweep {self._bucket.url.name} has no best policy yet.",
                f"Choose it with `tune-jobs best {name_in_commands(str(self._bucket.url))}`.",
            ) from error

    def write_best(self, record: BestRecord, policy: PortablePolicy | None = None) -> None:
        """Replace the winner; the sealed record is written after the policy."""
        self.check_not_removed()
        if policy is not None:
            made = self._parts.own() / "made" / names.BEST_FOLDER
            save_policy(policy, made)
            self._upload(names.BEST_FOLDER, made, sorted(made.iterdir()))
        self._write_record(names.BEST_RECORD, record)

    @property
    def best_folder(self) -> Path:
        """A local folder with the winner's portable policy."""
        return self._shared(names.BEST_FOLDER)

    @property
    def best_policy_path(self) -> Path:
        """The file in `best_folder` that a user is told to load."""
        return self._shared(names.BEST_FOLDER, fetched=False) / names.BEST_POLICY

    def films(self) -> dict[str, Path]:
        """Return the films that exist of the present winner."""
        folder = self.best_folder
        films = {key: folder / name for key, name in names.FILMS.items() if (folder / name).is_file()}
        return films if films and self._are_of_the_winner() else {}

    def _are_of_the_winner(self) -> bool:
        key = f"{names.BEST_FOLDER}/{names.FILMS_RECORD}"
        try:
            record = self._parts.read_record(key, FilmsRecord, "films record", is_sealed=True)
            return record.checkpoint == self.read_best().checkpoint
        except NotFoundError:
            return False

    def current_films(self) -> dict[str, Path]:
        """Return all films if they are there and show the present winner; else none."""
        films = self.films()
        return films if len(films) == len(names.FILMS) else {}

    @contextlib.contextmanager
    def writing_films(self) -> Iterator[Mapping[str, Path]]:
        """Yield the path for each of the films of the present winner."""
        # Not where others look: those bring that folder to what the store has.
        made = self._parts.own() / "made" / f"films-{secrets.token_hex(4)}"
        make_local(made)
        shown = self.read_best().checkpoint
        self._parts.remove_record(f"{names.BEST_FOLDER}/{names.FILMS_RECORD}")
        paths = {film: made / name for film, name in names.FILMS.items()}
        yield paths
        self.check_not_removed()
        self._upload(names.BEST_FOLDER, made, [path for path in paths.values() if path.is_file()])
        self._write_record(names.FILMS_RECORD, FilmsRecord(checkpoint=shown))

    def current_report(self) -> Path | None:
        """Return the report's page if it was written after the sweep's record, the winner and the films; else None."""
        # Not of all objects: the trials may have many thousands.
        items = [*self._bucket.listed(f"{names.BEST_FOLDER}/"), *self._bucket.listed(f"{names.REPORT_FOLDER}/")]
        record = self._bucket.look(names.SWEEP_RECORD)
        listed = {item.key: item.modified_s for item in [*items, *([record] if record is not None else [])]}
        page = listed.get(f"{names.REPORT_FOLDER}/{names.REPORT_PAGE}")
        of_best = (names.BEST_RECORD, *names.FILMS.values())
        shown = [names.SWEEP_RECORD, *(f"{names.BEST_FOLDER}/{name}" for name in of_best)]
        if page is None or any(listed.get(key, page) > page for key in shown):
            return None
        return self._shared(names.REPORT_FOLDER) / names.REPORT_PAGE

    def report_files(self) -> dict[str, Path]:
        """Return the files of the report that was written last, by their names."""
        folder = self._shared(names.REPORT_FOLDER)
        files = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith("."))
        return {path.relative_to(folder).as_posix(): path for path in files}

    @contextlib.contextmanager
    def writing_report(self) -> Iterator[Path]:
        """Yield a local folder to write the report into, over the present one."""
        folder = self._parts.own() / "made" / f"report-{secrets.token_hex(4)}"
        present = self._shared(names.REPORT_FOLDER)
        with filling():
            shutil.copytree(present, folder, ignore=shutil.ignore_patterns(".*"))
        yield folder
        self.check_not_removed()
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
        page = folder / names.REPORT_PAGE
        self._upload(names.REPORT_FOLDER, folder, [path for path in files if path != page])
        # Last: a page whose figures are missing would be half a report.
        self._upload(names.REPORT_FOLDER, folder, [page] if page.is_file() else [])


def _marked(path: Path) -> Path:
    return path.with_name(f".{path.name}.tag")


def _mark(path: Path, tag: Tag) -> None:
    """Note which content of an object a local file has."""
    found = path.stat()
    # Listings and answers to writes agree in the entity tag; not all of them have the version.
    with filling():
        _marked(path).write_text(repr((tag[0], found.st_size, found.st_mtime_ns)), encoding="utf-8")


def _differs(path: Path, item: Listed) -> bool:
    """Whether a local file is missing, or is not the content that an object has."""
    try:
        found = path.stat()
        noted = _marked(path).read_text(encoding="utf-8")
    except OSError:
        return True
    return item.tag[0] is None or noted != repr((item.tag[0], found.st_size, found.st_mtime_ns))
