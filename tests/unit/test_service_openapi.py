"""The OpenAPI document is whole, and the service answers as it says to whatever is asked."""

import contextlib
import copy
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias, cast

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, Verbosity, given, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from openapi_spec_validator import validate
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi import checks
from service_access import OPEN, SWEEP, URL, Place, place, raw_answer
from services import FAKE
from test_service_access_routes import routes_of
from test_service_downloads import make_finished

from tune_jobs.service.config import Limits, ServiceConfig
from tune_jobs.service.service import Service, opened

Operation: TypeAlias = schemathesis.APIOperation[Any, Any, Any, Any]
Case: TypeAlias = schemathesis.Case[Any]

METHODS = ("get", "head", "options", "post", "put", "patch", "delete", "trace")
STREAMS = ("/events", "/play")
"""Their answers are events, which the document calls a text."""
CHECKS = (
    schemathesis.checks.not_a_server_error, checks.status_code_conformance, checks.content_type_conformance,
    checks.response_headers_conformance, checks.response_schema_conformance, checks.negative_data_rejection,
)  # fmt: skip
EXAMPLES = 8
KNOWN = {
    "name": SWEEP, "trial_id": "t0003", "iteration": 6, "film": "after_mp4", "file": "policy.json",
    "path": "index.html", "number": 1,
}  # fmt: skip
RIGHT = {
    "/api/v1/plans": {"spec": FAKE, "overrides": ["num_samples=2"]},
    "/api/v1/sweeps": {"preset": "cartpole-ppo", "tags": ["x"]},
}
"""Bodies that are right: from their form alone nobody finds out what a sweep file may say."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service whose queue stands still, whose streams end at once, and where nothing is played."""
    storage = tmp_path_factory.mktemp("openapi") / "sweeps"
    with opened(ServiceConfig(storage=storage, port=8265, spare_idle_s=0, limits=Limits(players=0))) as made:
        made.supervisor.close()
        made.watching.close()
        yield made


@pytest.fixture
def at(service: Service) -> Place:
    """The service, where nobody is turned away for showing wrong tokens; it has a finished sweep."""
    restore(service)
    return place(service, limit=10**9)


def restore(service: Service) -> None:
    if not service.storage.is_taken(SWEEP):
        make_finished(Path(service.config.storage) / SWEEP)


@pytest.fixture
def document(at: Place) -> dict[str, Any]:
    found: dict[str, Any] = at.client().get("/api/v1/openapi.json").json()
    return found


def operations(document: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Method, path and description of each."""
    return [(method, path, said) for path, methods in document["paths"].items() for method, said in methods.items()]


# -- the document


def test_the_document_is_valid(document: dict[str, Any]) -> None:
    validate(document)
    assert len(operations(document)) > 30
    assert document["openapi"].startswith("3.1")


def lint(document: dict[str, Any]) -> list[str]:
    """What the document lacks, by our own rules."""
    names = Counter(said.get("operationId") for _, _, said in operations(document))
    found = [f"operationId {name} is there {count} times" for name, count in names.items() if count > 1 or not name]
    for method, path, said in operations(document):
        found += [f"{method} {path} {lack}" for lack in lacks(path, said)]
    schemas = document["components"]["schemas"]
    found += [
        f"the schema {name} is not described" for name, schema in schemas.items() if not schema.get("description")
    ]
    known = {f"#/components/schemas/{name}" for name in schemas}
    return [*found, *(f"{target} is nowhere" for target in set(references(document)) - known)]


def lacks(path: str, said: dict[str, Any]) -> Iterator[str]:
    """What the description of one operation lacks."""
    yield from (f"has no {part}" for part in ("tags", "summary", "description") if not said.get(part))
    for parameter in said.get("parameters", ()):
        if not parameter.get("description"):
            yield f"does not describe its parameter {parameter['name']}"
    responses = said["responses"]
    yield from (f"does not describe {status}" for status, item in responses.items() if not item.get("description"))
    for status, item in responses.items():
        # What monitors ask is answered in one form, whether it is ready or not.
        if status >= "400" and path != "/readyz" and list(item.get("content", ())) != ["application/problem+json"]:
            yield f"says that {status} is no problem document"
    if not responses.keys() & {"200", "201", "202", "204"}:
        yield "says nothing of success"
    if not responses.keys() >= {"400", "403", "413", "500", "503"}:
        yield "does not say what may go wrong"


def references(part: Any) -> Iterator[str]:
    """All that a part of a document refers to."""
    if isinstance(part, dict):
        if isinstance(part.get("$ref"), str):
            yield part["$ref"]
        for item in part.values():
            yield from references(item)
    elif isinstance(part, list):
        for item in part:
            yield from references(item)


def test_everything_in_the_document_is_described(document: dict[str, Any]) -> None:
    assert lint(document) == []


def drop(document: dict[str, Any], path: str, *keys: str) -> None:
    part: Any = document["paths"][path]
    for key in keys[:-1]:
        part = part[int(key)] if isinstance(part, list) else part[key]
    del part[keys[-1]]


@pytest.mark.parametrize(
    ("path", "keys", "said"),
    [
        ("/api/v1/me", ("get", "summary"), "no summary"), ("/api/v1/me", ("get", "tags"), "no tags"),
        ("/api/v1/me", ("get", "operationId"), "operationId"),
        ("/api/v1/sweeps/{name}", ("get", "parameters", "0", "description"), "parameter name"),
        ("/api/v1/me", ("get", "responses", "400"), "what may go wrong"),
        ("/api/v1/me", ("get", "responses", "200"), "nothing of success"),
        ("/api/v1/me", ("get", "responses", "401", "content", "application/problem+json"), "that 401 is no problem"),
    ],
)  # fmt: skip
def test_the_rules_find_what_is_missing(document: dict[str, Any], path: str, keys: tuple[str, ...], said: str) -> None:
    drop(document, path, *keys)
    assert any(said in line for line in lint(document)), lint(document)


def test_the_document_has_all_routes_of_the_interface(at: Place, document: dict[str, Any]) -> None:
    served = {(method.lower(), path.replace(":path}", "}")) for method, path in routes_of(at.app)}
    served = {(method, path) for method, path in served if path != "/" and not path.startswith("/static/")}
    told = {(method, path) for method, path, _ in operations(document)}
    # Of downloads the headers can be had alone; the document does not tell of itself.
    assert {item for item in served - told if item[0] != "head"} == {("get", "/api/v1/openapi.json")}
    assert told <= served


# -- requests, as the document describes them and otherwise


def fuzzed(at: Place) -> list[Operation]:
    """What is asked. Tokens are another test's matter: here nobody needs one."""
    document = copy.deepcopy(at.app.openapi())
    del document["security"], document["components"]["securitySchemes"]
    for _, _, said in operations(document):
        said.pop("security", None)
    schema = schemathesis.openapi.from_dict(document)
    schema.app = at.app
    found = [cast("Operation", result.ok()) for result in schema.get_all_operations()]  # type: ignore[union-attr]
    assert len(found) == len(operations(document))
    return found


def strategies(operation: Operation, mode: GenerationMode) -> list[st.SearchStrategy[Case]]:
    """Requests with any values, and with those of the sweep that is there; none where nothing could be wrong."""
    known = {name: value for name, value in KNOWN.items() if f"{{{name}}}" in operation.path}
    chosen: list[dict[str, Any]] = [{}, *([{"path_parameters": known}] if known else [])]
    if operation.method == "post" and operation.path in RIGHT and mode is GenerationMode.POSITIVE:
        chosen.append({"body": RIGHT[operation.path], "media_type": "application/json"})
    said = operation.definition.raw
    fields = said.get("parameters", ())
    is_free = "requestBody" in said or any(field["in"] != "path" for field in fields)
    # Any text can be a name.
    is_typed = any(field["schema"].get("type") != "string" or "enum" in field["schema"] for field in fields)
    return [
        operation.as_strategy(generation_mode=mode, **some)
        for some in chosen
        if mode is GenerationMode.POSITIVE or is_free or (is_typed and not some)
    ]


def ask(operation: Operation, strategy: st.SearchStrategy[Case]) -> tuple[Counter[int], list[str]]:
    """Send requests; return how often each status came, and what is wrong with the answers."""
    statuses, wrong = Counter[int](), list[str]()
    # What is listed, of the same requests each time.
    quick = settings(
        max_examples=EXAMPLES, derandomize=True, database=None, deadline=None, phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck), verbosity=Verbosity.quiet,
    )  # fmt: skip
    chosen = [
        check
        for check in CHECKS
        if (operation.path != "/readyz" or check is not schemathesis.checks.not_a_server_error)
        and (not operation.path.endswith(STREAMS) or check is not checks.response_schema_conformance)
    ]

    @quick
    @given(case=strategy)
    def send(case: Case) -> None:
        answer = case.call(base_url=URL)
        statuses[int(answer.status_code)] += 1
        try:
            # Too large a body is refused before anybody reads what is wrong in it; schemathesis does not know that.
            is_unread = answer.status_code == 413
            fitting = [check for check in chosen if not is_unread or check is not checks.negative_data_rejection]
            case.validate_response(answer, checks=fitting)
            if answer.status_code >= 400 and operation.path != "/readyz":
                told = answer.json()
                assert told["status"] == answer.status_code, told
                assert told["detail"].strip(), told
        except (AssertionError, schemathesis.errors.FailureGroup) as error:
            wrong.append(f"{case.as_curl_command()}\n{error}")

    # There may be nothing that would be wrong: any text is a name.
    with contextlib.suppress(Unsatisfiable):
        send()
    return statuses, wrong


@pytest.mark.parametrize("mode", list(GenerationMode))
def test_answers_are_as_the_document_says(at: Place, mode: GenerationMode) -> None:
    wrong, seen = list[str](), Counter[int]()
    for operation in fuzzed(at):
        for strategy in strategies(operation, mode):
            # Whatever was deleted is there again for the others.
            restore(at.service)
            statuses, found = ask(operation, strategy)
            seen += statuses
            wrong += found
    assert not wrong, "\n\n".join(wrong[:20])
    # That all of them were refused would be no test of anything.
    assert seen.keys() >= ({200, 201, 202, 204, 404} if mode is GenerationMode.POSITIVE else {400, 404, 422})


def test_unknown_methods_are_refused(at: Place, document: dict[str, Any]) -> None:
    for path, said in document["paths"].items():
        filled = re.sub(r"\{(\w+)\}", lambda found: str(KNOWN[found[1]]), path)
        answer = raw_answer(at.app, "OPTIONS", filled)
        allowed = {
            item.strip().lower()
            for name, value in answer.headers
            if name == b"allow"
            for item in value.decode().split(",")
        }
        assert allowed >= said.keys(), path
        for method in set(METHODS) - allowed:
            answer = raw_answer(at.app, method.upper(), filled)
            assert answer.status == 405, (method, path, answer)
            assert (b"content-type", b"application/problem+json") in answer.headers


def test_without_a_token_all_is_refused_as_the_document_says(service: Service, document: dict[str, Any]) -> None:
    at = place(service, **OPEN)
    for method, path, said in operations(document):
        filled = re.sub(r"\{(\w+)\}", lambda found: str(KNOWN[found[1]]), path)
        answer = raw_answer(at.app, method.upper(), filled)
        assert str(answer.status) in said["responses"], (method, path, answer)
        assert (answer.status == 401) == (said.get("security") != []) or path == "/api/v1/login", (method, path)
