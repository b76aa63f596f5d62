"""Where a request comes from: hosts, origins, proxies."""

import pytest
from service_access import OPEN, SWEEP, URL, Place, bearer, place, problem, shared  # noqa: F401 (fixture)

from policies.errors import SpecError
from tune_jobs.service.access.hosts import ServedNames, public_host
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

ME = "/api/v1/me"


# -- hosts and origins


@pytest.mark.parametrize("host", ["127.0.0.1:8265", "localhost:8265", "LOCALHOST:8265", "[::1]:8265", "[0:0::1]:8265"])
def test_this_machines_names_are_the_services(shared: Service, host: str) -> None:
    assert place(shared).client().get(ME, headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example", "evil.example:8265", "127.0.0.1", "127.0.0.1:8266", "localhost", "127.0.0.1.evil.example:8265",
        "localhost.:8265", "evil@localhost:8265", "localhost:8265@evil", "", " ", "localhost:", "localhost:8265/",
        "localhost:99999", "[::1", "[::2]:8265", "[]:8265", "2130706433:8265", "127.1:8265", "0.0.0.0:8265",
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", [ME, "/healthz", "/api/v1/sweeps"])
def test_a_host_that_is_not_the_services_is_refused(shared: Service, host: str, path: str) -> None:
    found = problem(place(shared).client().get(path, headers={"Host": host}), 400)
    assert "Host" in found["detail"] or "--public-name" in found["hint"]


def test_of_two_hosts_none_counts(shared: Service) -> None:
    for hosts in (("127.0.0.1:8265", "evil.example"), ("evil.example", "127.0.0.1:8265")):
        problem(place(shared).client().get(ME, headers=[("Host", host) for host in hosts]), 400)


def test_a_public_name_is_the_services_too(shared: Service) -> None:
    at = place(shared, public_names=("Tune.Example.org", "other.example:9000"))
    headers = bearer(at.token("viewer"))
    for host, status in (
        ("tune.example.org", 200), ("tune.example.org:1234", 200), ("other.example:9000", 200), ("other.example", 400),
        ("sub.tune.example.org", 400), ("localhost:8265", 200),
    ):  # fmt: skip
        assert at.client().get(ME, headers={"Host": host, **headers}).status_code == status, host


def test_who_listens_everywhere_is_known_by_the_address_that_was_called(shared: Service) -> None:
    at = place(shared, **OPEN)
    headers = bearer(at.token("viewer"))
    # A test client's server is what its URL says.
    assert at.client("http://192.0.2.7:8265").get(ME, headers=headers).status_code == 200
    problem(at.client("http://192.0.2.7:8265").get(ME, headers={"Host": "192.0.2.8:8265", **headers}), 400)
    problem(at.client("http://evil.example:8265").get(ME, headers=headers), 400)
    problem(place(shared).client("http://192.0.2.7:8265").get(ME), 400)


@pytest.mark.parametrize(
    ("address", "called", "host", "is_known"),
    [
        ("::", "::ffff:192.168.0.5", "192.168.0.5", True),
        ("::", "::ffff:192.168.0.5", "[::ffff:192.168.0.5]", True),
        ("::", "::ffff:192.168.0.5", "192.168.0.6", False),
        ("::", "fe80::1%eth0", "[fe80::1]", True),
        ("::", "fe80::1", "192.168.0.5", False),
        ("0.0.0.0", "192.168.0.5", "192.168.0.5", True),
        ("::1", "::ffff:192.168.0.5", "192.168.0.5", False),
    ],
)
def test_a_socket_of_version_6_is_known_by_addresses_of_version_4(
    address: str, called: str, host: str, *, is_known: bool
) -> None:
    names, headers = ServedNames(address), {b"host": [f"{host}:8470".encode()]}
    if is_known:
        assert names.check_host(headers, "http", (called, 8470)).port == 8470
    else:
        with pytest.raises(RefusedError, match="not known as"):
            names.check_host(headers, "http", (called, 8470))


@pytest.mark.parametrize(
    "name", ["https://x.example", "x.example/a", "a b", "", "bücher.example", "x:0", "x:y", "[:g]"]
)
def test_a_public_name_that_is_none(name: str) -> None:
    with pytest.raises(SpecError, match="no name of a host"):
        public_host(name)


FOREIGN = [
    "http://evil.example", "https://127.0.0.1:8265", "http://127.0.0.1", "http://127.0.0.1:8266", "http://localhost:8265",
    "null", "", "http://127.0.0.1:8265/", "http://127.0.0.1:8265.evil.example", "http://evil@127.0.0.1:8265", "file://",
    "http://[::1", "chrome-extension://abcdef",
]  # fmt: skip


@pytest.mark.parametrize("origin", FOREIGN)
@pytest.mark.parametrize("method", ["GET", "POST", "OPTIONS", "DELETE"])
def test_the_page_of_another_site_gets_nothing(shared: Service, origin: str, method: str) -> None:
    for path in (ME, "/healthz", "/api/v1/login"):
        found = problem(place(shared).client().request(method, path, headers={"Origin": origin}), 403)
        assert "another site" in found["detail"]


def test_the_own_page_is_let_in(shared: Service) -> None:
    client = place(shared).client()
    assert client.get(ME, headers={"Origin": URL}).status_code == 200
    for given in ({"Host": "localhost:8265", "Origin": "http://localhost:8265"}, {"Origin": "HTTP://127.0.0.1:8265"}):
        assert client.get(ME, headers=given).status_code == 200


def test_of_two_origins_none_counts(shared: Service) -> None:
    headers = [("Origin", URL), ("Origin", "http://evil.example")]
    problem(place(shared).client().get(ME, headers=headers), 403)


def test_another_site_may_lead_here_and_load_nothing(shared: Service) -> None:
    client = place(shared).client()

    def status(method: str = "GET", **said: str) -> int:
        headers = {f"Sec-Fetch-{name.title()}": value for name, value in said.items()}
        return int(client.request(method, ME, headers=headers).status_code)

    for site in ("cross-site", "same-site"):
        assert status(site=site, mode="no-cors", dest="image") == 403
        assert status(site=site, mode="navigate", dest="iframe") == 403
        assert status("POST", site=site, mode="navigate", dest="document") == 403
        assert status(site=site, mode="navigate", dest="document") == 200
    assert status(site="same-origin", mode="cors", dest="empty") == 200
    assert status(site="none", mode="navigate", dest="document") == 200


# -- behind a proxy


def test_a_proxy_says_who_asks_and_how(shared: Service) -> None:
    at = place(shared, behind_proxy="loopback", public_names=("tune.example.org",))
    client = at.client("http://tune.example.org", x_forwarded_for="198.51.100.1, 192.0.2.3", x_forwarded_proto="https")
    headers = {"Origin": "https://tune.example.org"}
    answer = client.post("/api/v1/login", json={"token": at.token("viewer")}, headers=headers)
    assert answer.headers["set-cookie"].startswith("__Host-tune-jobs-443=")
    assert at.audited()[0].client == "192.0.2.3"
    problem(client.get(ME, headers={"Origin": "http://tune.example.org"}), 403)


@pytest.mark.parametrize(
    ("proxy", "peer", "believed"),
    [
        (None, "127.0.0.1", False), ("loopback", "127.0.0.1", True), ("loopback", "::1", True),
        ("loopback", "192.0.2.1", False), ("192.0.2.1", "192.0.2.1", True), ("192.0.2.1", "::ffff:192.0.2.1", True),
        ("192.0.2.1", "127.0.0.1", False), ("2001:db8::1", "2001:DB8:0::1", True), ("loopback", "testclient", False),
    ],
)  # fmt: skip
def test_only_the_named_proxy_is_believed(shared: Service, proxy: str | None, peer: str, believed: bool) -> None:
    at = place(shared, behind_proxy=proxy, **OPEN)
    client = at.client(address=peer, x_forwarded_for="198.51.100.9")
    problem(client.post("/api/v1/login", json={"token": "x"}), 401)
    assert at.audited()[0].client == ("198.51.100.9" if believed else peer)


@pytest.mark.parametrize("text", ["", "unknown", "x, ", "192.0.2.1:99", "<script>", "1" * 1_000])
def test_a_proxy_that_names_no_address(shared: Service, text: str) -> None:
    at = place(shared, behind_proxy="loopback")
    problem(at.client(x_forwarded_for=text, x_forwarded_proto="gopher").post("/api/v1/login", json={"token": "x"}), 401)
    assert at.audited()[0].client == "127.0.0.1"
