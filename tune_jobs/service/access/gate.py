"""What decides who gets in: shared by the layer around the application and the route of logins."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import ceil

from sqlalchemy.exc import SQLAlchemyError

from policies.errors import CannotRunError
from tune_jobs.service.access.attempts import RateLimit, network_of
from tune_jobs.service.access.audit import Audit, Done
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.access.tokens import Token, Tokens
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.database.opening import open_database
from tune_jobs.service.outages import Outages


@dataclass(frozen=True)
class Gate:
    """What decides who gets in.

    Args:
        config: The service's settings.
        tokens: Who may come in.
        audit: Where what was done is written down.
        failed_logins: How often a client may show what is no token.
        outages: Where it is noted that the database can't be used.
    """

    config: ServiceConfig
    tokens: Tokens
    audit: Audit
    failed_logins: RateLimit = field(default_factory=RateLimit)
    outages: Outages = field(default_factory=Outages)

    def find(self, secret: str, client: str) -> Token | None:
        """Return the token of a secret, also if it is no longer valid; None: there is none.

        Args:
            secret: What was shown.
            client: The client's address.

        Raises:
            RefusedError: Too much that is no token has come from that address.
        """
        # One that was found before is not limited: nobody behind the same address is locked out by others' mistakes.
        if self.tokens.remembered(secret) is not None:
            return self.tokens.find(secret)
        network = network_of(client)
        wait_s = self.failed_logins.begin(network)
        if wait_s:
            raise RefusedError(
                429,
                "Too many wrong tokens have come from this address.",
                f"Try again in {ceil(wait_s)} s.",
                {"Retry-After": str(ceil(wait_s))},
            )
        token = self.tokens.find(secret)
        if token is not None:
            self.failed_logins.forgive(network)
        return token

    def write_command(self, action: str, token: Token) -> None:
        """Write down what a command on this machine has done with a token."""
        details = {"token": token.id, "name": token.name, "role": token.role}
        self.audit.write(Done("command line", "", action, "", 200, details))


@contextlib.contextmanager
def opened_gate(config: ServiceConfig) -> Iterator[Gate]:
    """Open the database for the block, to change tokens; a service may use it meanwhile.

    Raises:
        CannotRunError: The database can't be used.
    """
    if config.database is None:
        try:
            config.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise CannotRunError(
                f"The service's folder {config.folder} can't be made: {error.strerror}.", "Check the storage folder."
            ) from error
    engine = open_database(config.database_url)
    try:
        yield Gate(config, Tokens(engine), Audit(engine))
    except SQLAlchemyError as error:
        raise CannotRunError(f"The service's database can't be used: {error}.", "Try again.") from error
    finally:
        engine.dispose()
