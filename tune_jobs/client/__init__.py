"""A service of `tune-jobs serve`, asked from Python: `Client`; the command line's --server is made of it."""

from tune_jobs.client.client import Client
from tune_jobs.client.event_stream import Event
from tune_jobs.client.problems import ConflictError, LostConnectionError, NoServiceError, UnavailableError

__all__ = ["Client", "ConflictError", "Event", "LostConnectionError", "NoServiceError", "UnavailableError"]
