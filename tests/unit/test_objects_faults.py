"""What the object store's calls keep to while servers and networks fail: done whole, known again, or an error."""

import errno
import secrets
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from s3_faults import Faults

from policies.errors import CannotRunError, TuneJobsError
from tune_jobs.store.objects import clients
from tune_jobs.store.objects.bucket import Bucket, ConflictError, StorageError
from tune_jobs.store.objects.object_storage import ObjectStorage
from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.objects.url import ObjectUrl

SECRETS = {
    "AWS_ACCESS_KEY_ID": "AKIAOFTHETESTS000000",
    "AWS_SECRET_ACCESS_KEY": "very/secret+of0the1tests2",
    "AWS_SESSION_TOKEN": "session//token==of3the4tests",
}


@pytest.fixture
def bucket(faults: Faults) -> Bucket:
    return Bucket(ObjectUrl("s3", "sweeps", secrets.token_hex(4), {"endpoint": faults.endpoint}))


def uses(bucket: Bucket, path: Path) -> dict[str, Callable[[], object]]:
    """Every call, and what it says when it could be done once."""
    return {
        "get": lambda: bucket.get("a"),
        "look": lambda: bucket.look("a"),
        "fetch": lambda: bucket.fetch("a", path),
        "put": lambda: bucket.put("b", b"1"),
        "create": lambda: bucket.put(secrets.token_hex(4), secrets.token_bytes(8), is_new=True),
        "replace": lambda: bucket.put("c", secrets.token_bytes(8), over=bucket.put("c", secrets.token_bytes(8))),
        "delete": lambda: bucket.delete(["b"]),
        "listed": bucket.listed,
        "children": bucket.children,
    }


@pytest.mark.parametrize("act", ["before", "after", "torn", "slow", 503, 500, 429])
def test_what_fails_once_is_done_again(
    faults: Faults,
    bucket: Bucket,
    tmp_path: Path,
    act: str | int,
) -> None:
    bucket.put("a", b"content" * 100)
    path = tmp_path / "a"
    for name, use in uses(bucket, path).items():
        expected = use() if name in ("get", "look", "fetch") else None
        path.unlink(missing_ok=True)
        faults.clear()
        if isinstance(act, int):
            faults.rule("status", status=act)
        else:
            faults.rule(act, delay_s=0.02)
        found = use()
        assert not faults.rules[0].times, name
        if expected is not None:
            assert found == expected
        if name == "fetch":
            assert path.read_bytes() == b"content" * 100
            path.unlink()
    assert bucket.get("b") is None


@pytest.mark.parametrize("act", ["after", "before", "slow"])
def test_a_conditional_write_whose_answer_is_lost_is_known_again(
    faults: Faults,
    bucket: Bucket,
    monkeypatch: pytest.MonkeyPatch,
    act: str,
) -> None:
    if act == "slow":
        # Long enough for a request that nothing delays, on a busy machine too.
        monkeypatch.setattr(clients, "REQUEST_TIMEOUT_S", 2.0)
        monkeypatch.setattr(clients, "PATIENCE_S", 30.0)
        settings = {"delay_s": 3.0}
    else:
        settings = {}
    faults.rule(act, kinds="PUT", **settings)
    tag = bucket.put("a", b"one", is_new=True)
    faults.rule(act, kinds="PUT", **settings)
    tag = bucket.put("a", b"two", over=tag)
    assert not any(rule.times for rule in faults.rules)
    found = bucket.get("a")
    assert found is not None
    assert (found.data, found.tag) == (b"two", tag)


def test_a_conditional_write_whose_answer_is_lost_yields_to_who_wrote_since(
    faults: Faults,
    bucket: Bucket,
) -> None:
    other = Bucket(bucket.url)
    tag = bucket.put("a", b"one")
    faults.rule("after", kinds="PUT", keys="/a$", then=lambda: other.put("a", b"other's"))
    with pytest.raises(ConflictError, match="written by another process"):
        bucket.put("a", b"two", over=tag)
    found = bucket.get("a")
    assert found is not None
    assert found.data == b"other's"


def test_two_writes_at_once_that_the_store_refuses_both_are_done_again(
    faults: Faults,
    bucket: Bucket,
) -> None:
    body = "<Error><Code>ConditionalRequestConflict</Code><Message>At once.</Message></Error>"
    for key in "ab":
        faults.rule("status", kinds="PUT", keys=f"/{key}$", status=409, body=body)
    assert bucket.put("a", b"one", is_new=True)
    assert bucket.put("b", b"one")
    assert [bucket.get(key) is not None for key in "ab"] == [True, True]


@pytest.mark.parametrize(
    "answer",
    [
        (403, "InvalidAccessKeyId", "Check the credentials"),
        (403, "SignatureDoesNotMatch", "Check the credentials"),
        (403, "AccessDenied", "Check the credentials"),
        (403, "RequestTimeTooSkewed", "clock"),
        (400, "ExpiredToken", "has expired"),
        (400, "AuthorizationHeaderMalformed", r"\?region="),
        (301, "PermanentRedirect", r"\?region=REGION to .* `curl -sI https://sweeps.s3.amazonaws.com` tells it"),
        (404, "NoSuchBucket", "Make the bucket"),
    ],
)
def test_what_does_not_pass_is_one_error_at_once_without_secrets(
    faults: Faults,
    bucket: Bucket,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    answer: tuple[int, str, str],
) -> None:
    status, code, hint = answer
    for name, value in SECRETS.items():
        monkeypatch.setenv(name, value)
    # Some servers say the whole request again.
    told = f"The key {SECRETS['AWS_ACCESS_KEY_ID']} with {SECRETS['AWS_SESSION_TOKEN']} and Signature=0123abc is none."
    body = (
        f"<Error><Code>{code}</Code><Message>{told}</Message><AWSAccessKeyId>{SECRETS['AWS_ACCESS_KEY_ID']}"
        "</AWSAccessKeyId><SignatureProvided>0123abc</SignatureProvided></Error>"
    )
    for name, use in uses(bucket, tmp_path / "a").items():
        faults.clear()
        faults.rule("status", status=status, body=body, times=100)
        with pytest.raises(StorageError) as raised:
            use()
        error = raised.value
        assert not error.passes
        assert len(faults.requests) <= 2, name
        assert error.message.startswith(bucket.url.short)
        assert str(status) in error.message
        if name != "look" or status in (301, 404):
            # An answer to HEAD has no body.
            assert raised.match(hint)
        signature = faults.requests[0].authorization.rpartition("Signature=")[2]
        for secret in (*SECRETS.values(), "0123abc", signature):
            assert secret
            assert secret not in f"{error.message} {error.hint} {error!r} {error.__cause__}"
        assert error.__suppress_context__


@pytest.mark.parametrize(
    ("code", "said"),
    [("ContainerNotFound", "It does not exist.\nRequestId:1\nTime:2"), ("", "The specified bucket does not exist.")],
    ids=["Azure", "Google"],
)
def test_a_bucket_of_another_kind_of_store_that_is_missing_is_told_in_one_line(
    faults: Faults, bucket: Bucket, tmp_path: Path, code: str, said: str
) -> None:
    body = f"<Error>{f'<Code>{code}</Code>' if code else ''}<Message>{said}</Message></Error>"
    for name, use in uses(bucket, tmp_path / "a").items():
        faults.clear()
        faults.rule("status", status=404, body=body, times=100)
        with pytest.raises(StorageError, match="Make the bucket") as raised:
            use()
        assert "\n" not in raised.value.message, name


def test_googles_store_is_where_its_endpoint_says(
    faults: Faults, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    account = tmp_path / "account.json"
    account.write_text('{"disable_oauth": true, "client_email": "", "private_key": "", "private_key_id": ""}')
    monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT", str(account))
    bucket = Bucket(ObjectUrl("gs", "sweeps", "mine", {"endpoint": faults.endpoint}))
    faults.rule("status", status=403, body="<Error><Message>Not you.</Message></Error>", times=9)
    with pytest.raises(StorageError, match=r"gs://sweeps/mine/a cannot be read: status code: 403.*Not you.") as raised:
        bucket.get("a")
    assert "GOOGLE_SERVICE_ACCOUNT" in raised.value.hint
    assert "AWS" not in raised.value.hint


def test_a_store_that_is_away_is_named_with_what_happened(faults: Faults, bucket: Bucket) -> None:
    faults.away()
    with pytest.raises(StorageError, match=r"/a cannot be read: the connection was refused\.") as raised:
        bucket.get("a")
    assert raised.value.passes
    faults.back()
    assert bucket.get("a") is None


def test_an_answer_that_stays_torn_leaves_no_file(faults: Faults, bucket: Bucket, tmp_path: Path) -> None:
    bucket.put("a", b"x" * 100_000)
    faults.rule("torn", times=1000)
    with pytest.raises(StorageError, match="closed before the whole answer") as raised:
        bucket.fetch("a", tmp_path / "a")
    assert raised.value.passes
    assert list(tmp_path.iterdir()) == []


def test_a_local_file_that_is_gone_is_no_fault_of_the_store(bucket: Bucket, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as raised:
        bucket.put("a", tmp_path / "none")
    assert raised.value.errno == errno.ENOENT


def test_a_local_file_that_cannot_be_written_is_no_fault_of_the_store(bucket: Bucket, tmp_path: Path) -> None:
    bucket.put("a", b"x")
    (tmp_path / "file").touch()
    with pytest.raises(CannotRunError) as raised:
        bucket.fetch("a", tmp_path / "file" / "a")
    assert not isinstance(raised.value, StorageError)


def test_an_object_whose_key_no_sweep_has_is_named(faults: Faults, bucket: Bucket) -> None:
    body = (
        "<ListBucketResult><IsTruncated>false</IsTruncated><Contents><Key>a/../b</Key><Size>1</Size>"
        "<LastModified>2026-01-01T00:00:00.000Z</LastModified></Contents></ListBucketResult>"
    )
    faults.rule("status", kinds="LIST", status=200, body=body)
    with pytest.raises(StorageError, match=r'"a/\.\./b"') as raised:
        bucket.listed()
    assert not raised.value.passes
    assert "Remove that object" in raised.value.hint


def test_files_in_parts_and_lists_in_pages_come_whole(
    faults: Faults,
    bucket: Bucket,
    tmp_path: Path,
) -> None:
    large = secrets.token_bytes(6_000_000)
    (tmp_path / "large").write_bytes(large)
    for act in ("after", "before"):
        for skip, kinds in ((0, "POST"), (1, "PUT"), (1, "POST")):
            faults.clear()
            faults.rule(act, kinds=kinds, skip=skip)
            bucket.put("large", tmp_path / "large")
            assert not faults.rules[0].times
    tag = bucket.put("conditional", large, is_new=True)
    bucket.put("conditional", large[::-1], over=tag)
    with pytest.raises(ConflictError):
        bucket.put("conditional", large, over=tag)
    for key, content in {"large": large, "conditional": large[::-1]}.items():
        found = bucket.get(key)
        assert found is not None
        assert found.data == content


def test_a_sweep_in_a_bucket_that_is_missing_is_no_sweep_that_is_missing(faults: Faults) -> None:
    sweep = ObjectSweep(ObjectUrl("s3", "no-such-bucket", "mine", {"endpoint": faults.endpoint}))
    for use in (sweep.exists, sweep.read_record, sweep.create, sweep.is_driven, sweep.request_stop):
        with pytest.raises(StorageError, match="NoSuchBucket") as raised:
            use()
        assert "Make the bucket" in raised.value.hint


@pytest.mark.parametrize(
    "said",
    [
        "<Message>The region 'us-east-1' is wrong; expecting 'eu-west-1'</Message>",
        "<Message>Wrong.</Message><Region>eu-west-1</Region>",
    ],
)
def test_the_region_that_the_store_names_is_in_the_hint(faults: Faults, bucket: Bucket, said: str) -> None:
    faults.rule("status", status=400, body=f"<Error><Code>AuthorizationHeaderMalformed</Code>{said}</Error>")
    with pytest.raises(StorageError) as raised:
        bucket.listed()
    assert "add ?region=eu-west-1 to" in raised.value.hint


def test_a_web_server_that_is_no_object_store_is_told_at_once(faults: Faults, bucket: Bucket) -> None:
    for use in (lambda: bucket.put("a", b"1"), lambda: bucket.look("a")):
        faults.clear()
        faults.rule("status", status=200, body="<html><body>Welcome</body></html>", times=100)
        with pytest.raises(StorageError, match="no object store") as raised:
            use()
        assert not raised.value.passes
        assert "Correct the endpoint" in raised.value.hint
        assert len(faults.requests) == 1


def test_a_web_server_is_told_apart_from_a_store_without_sweeps(faults: Faults, bucket: Bucket) -> None:
    storage = ObjectStorage(bucket.url)
    assert storage.sweeps() == []
    assert not storage.is_taken("mine")
    faults.rule("status", status=200, body="<html><body>Welcome</body></html>", times=100)
    for use in (storage.sweeps, lambda: storage.is_taken("mine"), lambda: storage.new_sweep("mine")):
        with pytest.raises(TuneJobsError, match="no object store") as raised:
            use()
        assert "Correct the endpoint" in raised.value.hint


def test_patience_has_an_end(faults: Faults, bucket: Bucket) -> None:
    faults.rule("torn", kinds="LIST", times=10_000)
    bucket.put("a", b"x")
    began = time.monotonic()
    with pytest.raises(StorageError):
        bucket.listed()
    assert 1 < time.monotonic() - began < 20
