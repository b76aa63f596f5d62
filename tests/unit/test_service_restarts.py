"""What a service begins again when it starts, and what not."""

from test_service_supervisor import Place, place  # noqa: F401 (a fixture)

# ruff: noqa: F811 - fixtures are named as arguments


def test_a_start_begins_nothing_again_that_somebody_stopped_or_that_failed(place: Place) -> None:
    for name, state in (("waits", "created"), ("killed", "running"), ("dies", "running"), ("anew", "created")):
        place.add(name, state=state)
        job = place.queue.begin(name, "drive", {}, owner="ann", num_cpus=1.0)[0]
        if name == "waits":
            place.queue.request_stop(name)
        elif name == "anew":
            # The job of one of the same name, long before.
            place.queue.end(job.id, "stopped", at=1.0)
        else:
            place.queue.end(job.id, "stopped" if name == "killed" else "failed")
    for _ in range(2):
        place.new_service().reconcile()
        assert [job.sweep for job in place.queue.jobs("waiting")] == ["anew"]
