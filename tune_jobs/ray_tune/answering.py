"""Ask what listens at a cluster's address whether it is Ray, and takes our token, before Ray itself tries to join.

Ray 2.60 tries for half a minute or more where another program answers, for five minutes if that is a web server, and
for 20 s with a wrong token. One call to Ray's own service tells it in milliseconds.
"""

from __future__ import annotations

import os
from typing import Any, Literal

from policies.errors import CannotRunError
from tune_jobs.ray_tune.address import is_for_clients, place_of

_TIMEOUT_S = 10.0
_Kind = Literal["node", "client"]
# For machines that are nodes, the control process (GCS); for others, the proxy of Ray clients.
_METHODS: dict[_Kind, str] = {
    "node": "/ray.rpc.NodeInfoGcsService/CheckAlive",
    "client": "/ray.rpc.RayletDriver/ClusterInfo",
}
_PORTS = (
    "HOST:PORT is what `ray start --head` prints (port 6379 mostly), for machines that are nodes of the cluster; "
    "others join by ray://HOST:10001. The dashboard's port (8265) is neither."
)


def check_is_ray(address: str) -> None:
    """Check that Ray answers at an address, at the port that the address's form is for, and takes this machine's token.

    Args:
        address: `auto`, `host:port` or `ray://host:port`; something listens there.

    Raises:
        CannotRunError: It does not; the message says what answers there instead.
    """
    if os.environ.get("RAY_USE_TLS", "0").lower() in ("1", "true"):
        # Ray has certificates of its own for it.
        return
    host, port = place_of(address)
    target = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    kind: _Kind = "client" if is_for_clients(address) else "node"
    said, details = _ask(target, kind)
    if said == "UNAUTHENTICATED":
        raise wrong_token(address)
    if said == "UNIMPLEMENTED":
        other: _Kind = "node" if kind == "client" else "client"
        if _ask(target, other)[0] != "UNIMPLEMENTED":
            raise _wrong_port(address, target, kind)
        raise CannotRunError(f"What answers at {address} is not Ray's control process, but another service.", _PORTS)
    if said == "UNAVAILABLE":
        is_web = "Failed parsing HTTP/2" in details
        what = "is a web server or another program, not a Ray cluster" if is_web else f"is not Ray: {details}"
        raise CannotRunError(f"What answers at {address} {what}.", _PORTS)
    if said == "DEADLINE_EXCEEDED":
        raise CannotRunError(
            f"What listens at {address} did not answer within {_TIMEOUT_S:.0f} s.",
            f"Check that the cluster works (`ray status` on its head). {_PORTS}",
        )


def wrong_token(address: str) -> CannotRunError:
    """Return the error that the cluster does not take this machine's token."""
    return CannotRunError(
        f"The Ray cluster at {address} does not accept this machine's token.",
        "Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH to the cluster's token.",
    )


def _wrong_port(address: str, target: str, kind: _Kind) -> CannotRunError:
    if kind == "client":
        return CannotRunError(
            f"{address} names the port of Ray's control process, which does not speak with Ray clients.",
            f"On a node of the cluster, leave ray:// out (--address {target}); from outside, give the port of its "
            "clients, 10001 mostly.",
        )
    return CannotRunError(
        f"{address} is the port for Ray clients, and not that of Ray's control process.",
        f"Put ray:// before it (--address ray://{target}), or give the port that `ray start --head` prints.",
    )


def _ask(target: str, kind: _Kind) -> tuple[str, str]:
    """Return the name of gRPC's status, and its details."""
    import grpc
    from ray._private.authentication.grpc_authentication_client_interceptor import (
        _get_authentication_metadata_tuple,
    )

    # An empty message is a valid request of both methods.
    with grpc.insecure_channel(target, options=(("grpc.enable_http_proxy", 0),)) as channel:
        call: Any = channel.unary_unary(_METHODS[kind])
        try:
            call(b"", timeout=_TIMEOUT_S, metadata=_get_authentication_metadata_tuple())
        except grpc.RpcError as error:
            failed: Any = error
            return str(failed.code().name), str(failed.details())
    return "OK", ""
