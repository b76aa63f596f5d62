"""The address of something in an object store: `s3://bucket/prefix?endpoint=https://host`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self
from urllib.parse import parse_qsl, quote, unquote, urlencode, urlsplit

from policies.errors import SpecError
from tune_jobs.store.urls import URL_SCHEMES

_SETTINGS = {"s3": ("endpoint", "region"), "gs": ("endpoint",), "az": ("account", "endpoint")}


@dataclass(frozen=True)
class ObjectUrl:
    """A bucket, what every key in it begins with, and how the store is reached; never credentials."""

    scheme: str
    bucket: str
    prefix: str
    """Without a slash at its ends; empty: the whole bucket."""
    settings: Mapping[str, str] = field(default_factory=dict)
    """What stands in the query: the endpoint and the region, for example."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read an address.

        Raises:
            SpecError: It names no bucket, has credentials in it, or a setting or a part that is not known.
        """
        try:
            parts = urlsplit(text)
        except ValueError as error:
            raise SpecError(f"{text!r} is no address: {error}.", "Write s3://BUCKET/PREFIX.") from error
        if "@" in parts.netloc:
            raise SpecError(
                f"The storage at {parts.scheme}://{parts.netloc.rpartition('@')[2]} is given with credentials in it.",
                "Leave them out: they come from the environment (AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, say) "
                "or from the machine's role.",
            )
        if parts.scheme not in URL_SCHEMES:
            raise SpecError(
                f"{text!r} is not the address of an object store.",
                f"Begin it with {_or(f'{s}://' for s in URL_SCHEMES)}.",
            )
        if not parts.netloc:
            raise SpecError(f"{text!r} names no bucket.", f"Write {parts.scheme}://BUCKET/PREFIX.")
        path = unquote(parts.path).strip("/")
        if (
            parts.fragment
            or "%2f" in parts.path.lower()
            or any(part in ("", ".", "..") for part in path.split("/") if path)
        ):
            raise SpecError(f"{text!r} has parts that no key of an object may have.", "Leave out #, //, %2F, . and ..")
        settings = dict(parse_qsl(parts.query, keep_blank_values=True))
        known = _SETTINGS[parts.scheme]
        for name, value in settings.items():
            if name not in known or not value:
                raise SpecError(
                    f"The address {text!r} sets {name!r}, which {'is empty' if name in known else 'is not known'}.",
                    f"Behind the ? stand {_or(known)}, such as ?endpoint=http://host:9000. Credentials come from the "
                    "environment.",
                )
        return cls(parts.scheme, parts.netloc, path, settings)

    def child(self, name: str) -> ObjectUrl:
        """Return the address of a name below this one."""
        return ObjectUrl(self.scheme, self.bucket, f"{self.prefix}/{name}" if self.prefix else name, self.settings)

    @property
    def name(self) -> str:
        """The last part of the prefix."""
        return self.prefix.rpartition("/")[2]

    @property
    def parent(self) -> ObjectUrl:
        """The address without its last part."""
        return ObjectUrl(self.scheme, self.bucket, self.prefix.rpartition("/")[0], self.settings)

    @property
    def short(self) -> str:
        """The address as messages have it: without the settings."""
        return f"{self.scheme}://{self.bucket}" + (f"/{self.prefix}" if self.prefix else "")

    def __str__(self) -> str:
        """Return the address as it is parsed again."""
        path = quote(self.prefix)
        query = urlencode(self.settings, safe=":/")
        return f"{self.scheme}://{self.bucket}" + (f"/{path}" if path else "") + (f"?{query}" if query else "")


def _or(texts: object) -> str:
    *others, last = [str(text) for text in texts]  # type: ignore[attr-defined]
    return f"{', '.join(others)} or {last}" if others else last
