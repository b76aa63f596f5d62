"""Ask Ray's Jobs API (REST, on the head's dashboard) to run a command on the cluster; this module imports no ray.

Ray's own client does the same, but waits without end at an address that does not answer, prefers
RAY_ADDRESS to the address that it is given, and takes a second to import and ray[default], which the head alone needs.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self
from urllib.parse import quote, urlsplit

from pydantic import BaseModel, ConfigDict, ValidationError

from policies.errors import CannotRunError, SpecError, fit, said_by
from tune_jobs.process.http_client import http_client, wrong_proxy

if TYPE_CHECKING:
    import httpx2

JobState = Literal["PENDING", "RUNNING", "STOPPED", "SUCCEEDED", "FAILED"]
ENDED: frozenset[JobState] = frozenset({"STOPPED", "SUCCEEDED", "FAILED"})

_TIMEOUT_S = 30.0
_MAX_SAID = 300
_WHERE = (
    "Give the address of the head's dashboard, mostly http://HEAD:8265. Ports 6379 (nodes) and 10001 (ray:// clients) "
    "are others."
)
_NO_DASHBOARD = (
    "Check the address, and that the head was started with a dashboard: `pip install 'tune-jobs[cluster]'` there, then "
    "`ray start --head --include-dashboard=true --dashboard-host=0.0.0.0`."
)


class Job(BaseModel):
    """What the cluster says of a job; times and what else it says are left out."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    status: JobState
    message: str | None = None
    driver_exit_code: int | None = None

    @property
    def has_ended(self) -> bool:
        """Whether its process runs no more and won't."""
        return self.status in ENDED


def is_jobs_address(address: str | None) -> bool:
    """Whether an address is one of Ray's Jobs API, by its form."""
    return address is not None and address.lower().startswith(("http://", "https://"))


def check_jobs_address(address: str | None) -> str:
    """Return the address of a Jobs API without a slash at its end.

    Raises:
        SpecError: It has another form, or names a user or password, which would be written to the sweep's record.
    """
    if address is None or not is_jobs_address(address):
        given = "no --address is given" if address is None else f"--address is {address!r}"
        raise SpecError(f"--detach needs the address of Ray's Jobs API, and {given}.", _WHERE)
    try:
        parts = urlsplit(address)
        host, has_user, more = parts.hostname, "@" in parts.netloc, parts.query or parts.fragment
        _ = parts.port
    except ValueError:
        host, has_user, more = None, False, ""
    if has_user:
        raise SpecError(
            "The address names a user or a password, and addresses are written to records.",
            "Leave it out; Ray's token is taken from RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH.",
        )
    if not host or more:
        raise SpecError(f"{address!r} is not the address of Ray's Jobs API.", _WHERE)
    return address.rstrip("/")


def token_of(environment: Mapping[str, str]) -> str | None:
    """Return the token that Ray would show: with RAY_AUTH_MODE=token, from the environment, a file, or `~/.ray`.

    Raises:
        SpecError: There is to be one, and there is none.
    """
    if environment.get("RAY_AUTH_MODE", "").lower() != "token":
        return None
    token = environment.get("RAY_AUTH_TOKEN", "").strip()
    if token and not (token.isascii() and token.isprintable()):
        raise SpecError("RAY_AUTH_TOKEN is no token: it has characters that no token has.", "Set it to the cluster's.")
    if token:
        return token
    named = environment.get("RAY_AUTH_TOKEN_PATH")
    where = "RAY_AUTH_TOKEN_PATH" if named else "~/.ray/auth_token"
    try:
        path = Path(named) if named else Path.home() / ".ray" / "auth_token"
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, ValueError, RuntimeError) as error:
        raise SpecError(
            f"RAY_AUTH_MODE is token, RAY_AUTH_TOKEN is not set, and {where} cannot be read: {said_by(error)}.",
            "Set one of them to the cluster's token.",
        ) from error
    if not token or not token.isascii() or not token.isprintable():
        raise SpecError(f"There is no token in {where}.", "Write the cluster's token to it.")
    return token


class JobsApi:
    """The Jobs API at one address, which is shown Ray's token, if there is one.

    Args:
        address: `http://head:8265`, or with https. The user has named it: see `known_clusters` for one of a record.
        timeout_s: How long an answer may take.

    Raises:
        SpecError: The address has another form, there is no token though there is to be one, or the environment names a
            proxy or certificates that are none.
        CannotRunError: What a proxy of the environment needs is not installed.
    """

    def __init__(self, address: str, *, timeout_s: float = _TIMEOUT_S) -> None:

        self.address = check_jobs_address(address)
        token = token_of(os.environ)
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._http = http_client(self.address, headers=headers, timeout=timeout_s)
        self.shows_token = token is not None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def ray_version(self) -> str:
        """Return the version of the cluster's Ray.

        Raises:
            CannotRunError: What answers there is not Ray's Jobs API, nothing does, or the token is refused.
        """
        found = self._json("GET", "/api/version")
        version = found.get("ray_version") if isinstance(found, dict) else None
        if not isinstance(version, str):
            raise self._not_ray("it tells no version of Ray")
        return version

    def upload(self, content: bytes) -> str:
        """Give the cluster a zip file, and return the URI by which a job's runtime_env names it.

        Raises:
            CannotRunError: The cluster does not take it.
        """
        # Named after its content, as Ray does: the same folder is sent once.
        name = f"_ray_pkg_{hashlib.sha256(content).hexdigest()[:32]}.zip"
        if self._request("GET", f"/api/packages/gcs/{name}").status_code != 200:
            answer = self._request("PUT", f"/api/packages/gcs/{name}", content=content)
            if answer.status_code != 200:
                raise self._refused("take the folder with your modules", answer)
        return f"gcs://{name}"

    def submit(
        self, submission_id: str, entrypoint: str, runtime_env: Mapping[str, Any], metadata: Mapping[str, str]
    ) -> None:
        """Begin a job.

        Args:
            submission_id: Its id, which no other job of the cluster has.
            entrypoint: A command of a shell.
            runtime_env: Ray's description of its environment; it holds no secrets, as everybody can ask for it.
            metadata: Notes on it.

        Raises:
            CannotRunError: The cluster refuses it.
        """
        body = {
            "submission_id": submission_id, "entrypoint": entrypoint, "runtime_env": dict(runtime_env),
            "metadata": dict(metadata),
        }  # fmt: skip
        answer = self._request("POST", "/api/jobs/", json=body)
        if answer.status_code != 200:
            raise self._refused(f"run job {submission_id}", answer)

    def job(self, submission_id: str) -> Job | None:
        """Return what becomes of a job; None: the cluster knows no such job, as its head was started anew, say.

        Raises:
            CannotRunError: The same as of `ray_version`.
        """
        answer = self._request("GET", f"/api/jobs/{quote(submission_id, safe='')}")
        if answer.status_code == 404 and "does not exist" in answer.text:
            return None
        if answer.status_code != 200:
            raise self._refused(f"tell of job {submission_id}", answer)
        try:
            return Job.model_validate_json(answer.content)
        except ValidationError as error:
            raise self._not_ray("it tells of a job in another form") from error

    def stop(self, submission_id: str) -> bool:
        """End a job; its process gets SIGTERM first.

        Returns:
            Whether it had not ended.

        Raises:
            CannotRunError: The same as of `ray_version`.
        """
        found = self._json("POST", f"/api/jobs/{quote(submission_id, safe='')}/stop")
        return bool(isinstance(found, dict) and found.get("stopped"))

    def _json(self, method: str, path: str) -> Any:
        answer = self._request(method, path)
        if answer.status_code != 200:
            raise self._not_ray(f"it answers {answer.status_code} to {method} {path}")
        try:
            return json.loads(answer.content)
        except ValueError as error:
            raise self._not_ray("its answer is no JSON") from error

    def _request(self, method: str, path: str, **more: Any) -> httpx2.Response:
        import httpx2

        try:
            answer = self._http.request(method, f"{self.address}{path}", **more)
        except httpx2.ConnectError as error:
            if wrong := wrong_proxy(self.address):
                raise wrong from None
            raise CannotRunError(
                f"Nothing answers at {self.address}: {said_by(error) or type(error).__name__}.", _NO_DASHBOARD
            ) from error
        except httpx2.TimeoutException as error:
            raise CannotRunError(
                f"{self.address} does not answer in time.", f"See whether the cluster is well. {_WHERE}"
            ) from error
        except (httpx2.HTTPError, httpx2.InvalidURL, UnicodeError) as error:
            # That of Unicode is of a host's name that the DNS can't hold, such as a..b, be it that of a proxy.
            if isinstance(error, UnicodeError) and (wrong := wrong_proxy(self.address)):
                raise wrong from None
            raise self._not_ray(said_by(error) or type(error).__name__) from error
        if answer.status_code in (401, 403):
            shown = "does not accept this machine's token" if self.shows_token else "wants a token"
            raise CannotRunError(
                f"The Ray cluster at {self.address} {shown}.",
                "Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH to the cluster's token.",
            )
        return answer

    def _not_ray(self, why: str) -> CannotRunError:
        return CannotRunError(f"What answers at {self.address} is not Ray's Jobs API: {fit(why, _MAX_SAID)}.", _WHERE)

    def _refused(self, what: str, answer: httpx2.Response) -> CannotRunError:
        # A traceback of the cluster's, whose last line is the error.
        lines = [line.strip() for line in answer.text.strip().splitlines() if line.strip()]
        said = fit(lines[-1], _MAX_SAID).rstrip(".") if lines else "it does not say why"
        return CannotRunError(
            f"The Ray cluster at {self.address} does not {what}: {said} (status {answer.status_code}).",
            "See the logs of its dashboard for more, and try again.",
        )
