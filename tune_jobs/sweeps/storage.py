"""Find the place that sweeps are stored at, and the place of a new sweep."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path
from urllib.parse import parse_qsl, quote, urlencode

from policies.errors import SpecError
from policies.files import absolute, expanded
from tune_jobs.spec.sweep_spec import check_sweep_name, name_after
from tune_jobs.store.command_names import DEFAULT_STORAGE
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import is_url, open_storage
from tune_jobs.store.urls import URL_SCHEMES, folder_of, name_of_place, outer_place

_KNOWN = ", ".join(f"{scheme}://" for scheme in URL_SCHEMES)
_URL = re.compile(
    r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]*)://(?P<bucket>[^/?]*)(?P<path>[^?]*)(?:\?(?P<query>.*))?", re.DOTALL
)
# What a `Path` makes of a URL.
_SLASH_LOST = re.compile(rf"({'|'.join((*URL_SCHEMES, 'file'))}):/(?!/)", re.IGNORECASE)
# Names in a query that hold what nobody may see, whichever library they are from.
_SECRET = re.compile(
    r"secret|password|token|credential|signature|^sig$|(access|account|api|shared|storage)_?key", re.IGNORECASE
)
_WITHOUT_SECRETS = (
    "A place is written to logs and records; give credentials by the environment (such as AWS_ACCESS_KEY_ID and "
    "AWS_SECRET_ACCESS_KEY), a profile or the machine's role."
)


def storage_place(storage: str | Path | None) -> str:
    """Return the given storage, else $TUNE_JOBS_STORAGE, else ./sweeps: an absolute folder, or a URL.

    Raises:
        SpecError: It is a URL that is none of an object store.
    """
    place = place_named(storage or os.environ.get("TUNE_JOBS_STORAGE") or DEFAULT_STORAGE)
    return place if is_url(place) else str(absolute(Path(place)))


def place_named(place: str | Path) -> str:
    """Return a place that a user named, as every process opens it.

    A URL gets what the environment says of its store, so that processes with another environment reach the same one:
    one without settings those of $TUNE_JOBS_STORAGE, if that is in the same bucket; and for s3, the `endpoint`
    ($AWS_ENDPOINT_URL_S3, else $AWS_ENDPOINT_URL) and the `region` ($AWS_REGION, else $AWS_DEFAULT_REGION).

    Args:
        place: A folder, of which ~ is replaced, and which may be relative; or a URL.

    Raises:
        SpecError: It is a URL with a scheme that is not known, without a bucket, or with credentials.
    """
    if _SLASH_LOST.match(str(place)):
        raise SpecError(
            f"{str(place)!r} has one slash where a URL has two; a Path takes one away.",
            "Give a URL as a text, with :// behind its scheme.",
        )
    found = _URL.fullmatch(place) if isinstance(place, str) else None
    if found is None:
        return str(expanded(place))
    scheme = found["scheme"].lower()
    if scheme == "file":
        return _folder_named(found)
    if scheme not in URL_SCHEMES:
        raise SpecError(
            f"Sweeps can't be kept at {scheme}://: known are {_KNOWN}, file:// and folders.",
            "Choose one of these; an S3-compatible server is s3://BUCKET/PREFIX?endpoint=http://HOST:PORT.",
        )
    _refuse_secrets(f"The {scheme}:// URL", scheme, found)
    parts = found["path"].strip("/").split("/") if found["path"].strip("/") else []
    if not found["bucket"] or {"", ".", ".."} & set(parts):
        what = "names no bucket" if not found["bucket"] else "has an empty part, or one that is . or .."
        raise SpecError(f"The URL {place!r} {what}.", f"Give {scheme}://BUCKET/PREFIX.")
    settings = dict(parse_qsl(found["query"] or _query_of_default(scheme, found["bucket"]), keep_blank_values=True))
    if scheme == "s3":
        settings = _from_environment() | settings
    query = urlencode(settings, quote_via=quote, safe=":/")
    return "/".join([f"{scheme}://{found['bucket']}", *parts]) + (f"?{query}" if query else "")


def _folder_named(found: re.Match[str]) -> str:
    if found["bucket"].lower() not in ("", "localhost") or not found["path"].startswith("/"):
        raise SpecError(f"The URL {found.group()!r} names no folder of this machine.", "Give file:///FOLDER.")
    return str(folder_of(found.group()))


def _query_of_default(scheme: str, bucket: str) -> str:
    """Return the query of $TUNE_JOBS_STORAGE, if that is in this bucket; else nothing."""
    found = _URL.fullmatch(os.environ.get("TUNE_JOBS_STORAGE", ""))
    if found is None or (found["scheme"].lower(), found["bucket"]) != (scheme, bucket):
        return ""
    _refuse_secrets("$TUNE_JOBS_STORAGE", scheme, found)
    return found["query"] or ""


def _refuse_secrets(named: str, scheme: str, url: re.Match[str]) -> None:
    """Raise an error if there may be credentials in a URL; it repeats nothing of it."""
    if ":" in url["bucket"]:
        # A secret may have a slash in it, so that its end stands in what looks like the prefix.
        raise SpecError(
            f"{named} has a colon where its bucket is named: credentials, or a port.",
            f"{_WITHOUT_SECRETS} A server's address is a setting: {scheme}://BUCKET/PREFIX?endpoint=http://HOST:PORT.",
        )
    names = [name for name, value in parse_qsl(url["query"] or "") if _SECRET.search(name) or "@" in value]
    if "@" in url["bucket"] or names:
        where = f"in its settings ({', '.join(map(repr, names))})" if names else "before its bucket"
        raise SpecError(f"{named} has credentials {where}.", _WITHOUT_SECRETS)


def _from_environment() -> dict[str, str]:
    """Return what the environment says of the S3 that is meant."""
    variables = {
        "endpoint": ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL"),
        "region": ("AWS_REGION", "AWS_DEFAULT_REGION"),
    }
    found = {}
    for setting, names in variables.items():
        name = next((name for name in names if os.environ.get(name)), None)
        if name is None:
            continue
        if "@" in os.environ[name]:
            raise SpecError(f"${name} has credentials in it.", _WITHOUT_SECRETS)
        found[setting] = os.environ[name]
    return found


def split_trial(source: str) -> tuple[str, str]:
    """Return the sweep and the trial of `SWEEP/TRIAL`, and of such a URL; both are empty if there is no slash in it."""
    if is_url(source):
        name = name_of_place(source)
        return (outer_place(source), name) if name else ("", "")
    sweep, _, trial_id = source.rpartition("/")
    return (sweep, trial_id) if sweep else ("", "")


def absolute_folder(folder: Path | None) -> Path | None:
    """Return a folder of this machine as an absolute one, with ~ replaced; None stays None.

    Raises:
        SpecError: It is a URL.
    """
    return None if folder is None else absolute(local_path(folder))


def local_path(path: str | Path) -> Path:
    """Return the path of what is to be written on this machine, with ~ replaced.

    Raises:
        SpecError: It is a URL, of which a folder called after the scheme would be made here.
    """
    if _URL.match(str(path)) or _SLASH_LOST.match(str(path)):
        # It may have credentials in it: only the scheme is repeated.
        scheme = str(path).partition(":")[0]
        raise SpecError(
            f"A URL ({scheme}://) is given for what is written on this machine.", "Give a folder or file of it."
        )
    return expanded(path)


def folder_at(place: str) -> Path:
    """Return the folder of a sweep that is in one.

    Raises:
        SpecError: The sweep is in an object store, and has none.
    """
    if is_url(place):
        raise SpecError(
            f"The sweep at {place} has no folder: it is in an object store.",
            "Use `place`, which every command and function takes, and the paths of single results in `artifacts`.",
        )
    return Path(place)


def shown_place(place: str) -> str | Path:
    """Return a place for a notebook, which makes a link of a folder."""
    return place if is_url(place) else Path(place)


def choose_store(name: str | None, stem: str, storage: str | Path) -> Sweep:
    """Choose the place of a new sweep, without making it.

    Args:
        name: The name that was asked for; None: `stem`, with a number if it is taken.
        stem: Name of the sweep file or preset.
        storage: Where sweeps are kept.

    Raises:
        SpecError: The name that was asked for is taken, or is not allowed as a folder's name.
    """
    kept = open_storage(storage)
    if name is not None:
        return kept.new_sweep(check_sweep_name(name))
    stem = name_after(stem)
    # Only the creation of the folder decides whether a name is free; this finds one that is likely free.
    number = 1
    while True:
        candidate = stem if number == 1 else f"{stem}-{number}"
        try:
            check_sweep_name(candidate)
        except SpecError as error:
            raise SpecError(
                f"The sweep would be called {candidate!r}, after its file; that is not allowed as a sweep's name.",
                f"Give another with --name (in Python name=). {error.hint}",
            ) from error
        if not kept.is_taken(candidate):
            return kept.sweep(candidate)
        number += 1


def stem_of(source: object) -> str:
    """Return the default name of a sweep from this source."""
    return Path(source).stem if isinstance(source, str | Path) else "sweep"


def create_store(name: str | None, stem: str, storage: str | Path) -> Sweep:
    """Make the place of a new sweep; several processes at once each get one of their own.

    Args:
        name: The same as for `choose_store`.
        stem: The same as for `choose_store`.
        storage: The same as for `choose_store`.

    Raises:
        SpecError: In the same cases as `choose_store`.
        CannotRunError: The storage cannot be written.
    """
    if name is not None:
        store = open_storage(storage).sweep(check_sweep_name(name))
        try:
            store.create()
        except SpecError:
            # It says what is there.
            choose_store(name, stem, storage)
            raise
        return store
    while True:
        store = choose_store(name, stem, storage)
        # Where it was taken since it was chosen, another one is.
        with contextlib.suppress(SpecError):
            store.create()
            return store
