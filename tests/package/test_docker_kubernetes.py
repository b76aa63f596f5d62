"""The Kubernetes manifests, with sweeps in a volume and in a bucket: their schemas, and what they promise.

No Kubernetes is here: nothing says that KubeRay makes of them what it should.
"""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from image import read_dockerfile
from kuberay_schema import problems
from kustomize import add, render

from tune_jobs.cli.commands import cli
from tune_jobs.cli.serve_command import serve
from tune_jobs.spec.file import load_spec

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
FOLDER = ROOT / "docker" / "kubernetes"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PINS = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
CLUSTERS = {"RayCluster": (), "RayJob": ("rayClusterSpec",), "RayCronJob": ("jobTemplate", "rayClusterSpec")}
PORTS = {"gcs": 6379, "dashboard": 8265, "client": 10001}


@pytest.fixture(params=["storage-pvc", "storage-s3"])
def storage(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=["service", "sweep", "nightly"])
def manifests(request: pytest.FixtureRequest, storage: str) -> list[dict[str, Any]]:
    return render(FOLDER / str(request.param), component=FOLDER / storage)


def of_kind(manifests: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [manifest for manifest in manifests if manifest["kind"] == kind]


def clusters(manifests: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The specs of all Ray clusters."""
    found = []
    for kind, path in CLUSTERS.items():
        for manifest in of_kind(manifests, kind):
            spec = manifest["spec"]
            for part in path:
                spec = spec[part]
            found.append(spec)
    return found


def ray_pods(manifests: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        group["template"]
        for spec in clusters(manifests)
        for group in [spec["headGroupSpec"], *spec["workerGroupSpecs"]]
    ]


def pods(manifests: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [*ray_pods(manifests), *(one["spec"]["template"] for one in of_kind(manifests, "Deployment"))]


def test_every_manifest_is_of_its_schema(manifests: list[dict[str, Any]]) -> None:
    assert {f"{one['kind']} {one['metadata']['name']}": problems(one) for one in manifests if problems(one)} == {}
    assert len(clusters(manifests)) == 1
    assert {one["metadata"]["namespace"] for one in manifests} == {"tune-jobs"}
    names = [(one["kind"], one["metadata"]["name"]) for one in manifests]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("/spec/authOptions/mode", "tokens", "spec.authOptions.mode"),
        ("/spec/authOption", {}, "authOption"),
        ("/spec/headGroupSpec/rayStartParams/num-cpus", 0, "num-cpus"),
        ("/spec/workerGroupSpecs/0/maxReplicas", "8", "maxReplicas"),
        ("/spec/workerGroupSpecs/0/template/spec/containers/0/volumeMount", [], "volumeMount"),
        ("/spec/headGroupSpec/template/spec/securityContext/runAsUser", "tune", "runAsUser"),
    ],
)
def test_a_wrong_field_is_found(path: str, value: object, named: str) -> None:
    (cluster,) = of_kind(render(FOLDER / "service", component=FOLDER / "storage-pvc"), "RayCluster")
    add(cluster, {"op": "add", "path": path, "value": value})
    assert any(named in problem for problem in problems(cluster))


def test_every_pod_has_no_rights_and_a_limit(manifests: list[dict[str, Any]]) -> None:
    (user,) = [one.rest for one in read_dockerfile(ROOT / "docker" / "Dockerfile") if one.word == "USER"]
    for pod in pods(manifests):
        spec = pod["spec"]
        context = spec["securityContext"]
        assert context["runAsNonRoot"] is True
        assert f"{context['runAsUser']}:{context['runAsGroup']}" == user
        # A volume that nobody else wrote to is made this group's.
        assert context["fsGroup"] == context["runAsGroup"]
        assert context["seccompProfile"] == {"type": "RuntimeDefault"}
        assert not {"hostNetwork", "hostPID", "hostIPC"} & spec.keys()
        (container,) = spec["containers"]
        for one in [container, *spec.get("initContainers", [])]:
            assert one["securityContext"] == {
                "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
            }  # fmt: skip
            assert one["resources"]["limits"].keys() >= {"cpu", "memory"}
            assert one["resources"]["requests"]["memory"] == one["resources"]["limits"]["memory"]
            assert {"name": "tmp", "mountPath": "/tmp"} in one["volumeMounts"]
        (tmp,) = [volume for volume in spec["volumes"] if volume["name"] == "tmp"]
        assert "sizeLimit" in tmp["emptyDir"]
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        assert mounted == {volume["name"] for volume in spec["volumes"]}
    for spec in clusters(manifests):
        if spec.get("enableInTreeAutoscaling"):
            autoscaler = spec["autoscalerOptions"]
            assert autoscaler["securityContext"]["readOnlyRootFilesystem"] is True
            assert autoscaler["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        else:
            # The autoscaler's sidecar alone asks Kubernetes for something.
            head = spec["headGroupSpec"]["template"]["spec"]
            assert head["automountServiceAccountToken"] is False
        workers = [group["template"]["spec"] for group in spec["workerGroupSpecs"]]
        assert all(one["automountServiceAccountToken"] is False for one in workers)


def test_every_ray_process_has_the_token_of_one_secret_and_no_secret_is_written_here(
    manifests: list[dict[str, Any]],
) -> None:
    for spec in clusters(manifests):
        assert spec["authOptions"] == {"mode": "token", "secretName": "tune-jobs-ray-token"}
    for deployment in of_kind(manifests, "Deployment"):
        (container,) = deployment["spec"]["template"]["spec"]["containers"]
        environment = {entry["name"]: entry for entry in container["env"]}
        assert environment["RAY_AUTH_MODE"]["value"] == "token"
        reference = environment["RAY_AUTH_TOKEN"]["valueFrom"]["secretKeyRef"]
        assert reference == {"name": "tune-jobs-ray-token", "key": "auth_token"}
        assert "value" not in environment["TUNE_JOBS_DATABASE"]
    assert of_kind(manifests, "Secret") == []
    readme = (ROOT / "docker" / "README.md").read_text()
    assert "--from-literal=auth_token=" in readme
    named = set(
        re.findall(r"'secret(?:KeyRef|Ref)': {[^}]*'name': '([\w-]+)'|'secretName': '([\w-]+)'", str(manifests))
    )
    assert named
    for first, second in named:
        assert f"create secret generic {first or second} " in readme


def test_the_image_and_ray_are_of_the_versions_here(manifests: list[dict[str, Any]]) -> None:
    for pod in pods(manifests):
        for container in [*pod["spec"]["containers"], *pod["spec"].get("initContainers", [])]:
            assert container["image"] == f"tune-jobs:{PROJECT['version']}"
    assert [spec["rayVersion"] for spec in clusters(manifests)] == [PINS["ray"]]
    for path in FOLDER.glob("*/kustomization.yaml"):
        for image in yaml.safe_load(path.read_text()).get("images", []):
            assert image == {"name": "tune-jobs", "newName": "tune-jobs", "newTag": PROJECT["version"]}
    # Ray's job server and the agents that answer the probes come with this extra.
    assert PROJECT["optional-dependencies"]["cluster"][0].startswith("ray[default]")
    assert any("e['cluster']" in one.rest for one in read_dockerfile(ROOT / "docker" / "Dockerfile"))


def test_probes_ask_ports_that_there_are_and_need_no_token(manifests: list[dict[str, Any]]) -> None:
    from ray.dashboard.http_server_agent import HttpServerAgent  # noqa: F401  (it is there: the extra is installed)

    for pod in pods(manifests):
        (container,) = pod["spec"]["containers"]
        ports = {port["name"]: port["containerPort"] for port in container["ports"]}
        for name in ("startupProbe", "readinessProbe", "livenessProbe"):
            asked = container[name]["httpGet"]
            expected = {
                "ray-head": ("/api/gcs_healthz", 8265), "ray-worker": ("/api/local_raylet_healthz", 52365),
                "service": ("/healthz" if name == "livenessProbe" else "/readyz", 8470),
            }[container["name"]]  # fmt: skip
            assert (asked["path"], ports[asked["port"]]) == expected
    for spec in clusters(manifests):
        head = spec["headGroupSpec"]
        (container,) = head["template"]["spec"]["containers"]
        assert {port["name"]: port["containerPort"] for port in container["ports"]} == PORTS
        # The head takes no trials, and its dashboard is reached by the probe from outside of the pod.
        assert (head["rayStartParams"]["num-cpus"], head["rayStartParams"]["dashboard-host"]) == ("0", "0.0.0.0")


def test_rays_ports_are_open_to_the_cluster_the_operator_and_the_service_alone(
    manifests: list[dict[str, Any]],
) -> None:
    policies = of_kind(manifests, "NetworkPolicy")
    for pod in pods(manifests):
        labels = pod["metadata"]["labels"]
        chosen = [
            policy for policy in policies if policy["spec"]["podSelector"]["matchLabels"].items() <= labels.items()
        ]
        (policy,) = chosen
        assert policy["spec"]["policyTypes"] == ["Ingress"]
    for policy in policies:
        component = policy["spec"]["podSelector"]["matchLabels"]["app.kubernetes.io/component"]
        for rule in policy["spec"]["ingress"]:
            ports = {port["port"] for port in rule.get("ports", [])}
            for peer in rule["from"]:
                labels = peer["podSelector"].get("matchLabels", {})
                if component == "service":
                    assert ports == {8470}
                elif labels.get("app.kubernetes.io/name") == "kuberay-operator":
                    assert ports == {PORTS["dashboard"]}
                elif labels["app.kubernetes.io/component"] == "service":
                    assert ports == {PORTS["client"]}
                else:
                    assert labels == policy["spec"]["podSelector"]["matchLabels"]


def test_sweeps_are_kept_where_every_pod_reaches_them(manifests: list[dict[str, Any]], storage: str) -> None:
    (settings,) = [one for one in of_kind(manifests, "ConfigMap") if one["metadata"]["name"] == "tune-jobs-settings"]
    place = settings["data"]["TUNE_JOBS_STORAGE"]
    claims = [
        one for one in of_kind(manifests, "PersistentVolumeClaim") if one["metadata"]["name"] != "tune-jobs-service"
    ]
    for pod in pods(manifests):
        (container,) = pod["spec"]["containers"]
        sources = container["envFrom"]
        assert {"configMapRef": {"name": "tune-jobs-settings"}} in sources
        volumes = {volume["name"]: volume for volume in pod["spec"]["volumes"]}
        if storage == "storage-pvc":
            (claim,) = claims
            assert claim["spec"]["accessModes"] == ["ReadWriteMany"]
            assert volumes["sweeps"]["persistentVolumeClaim"] == {"claimName": claim["metadata"]["name"]}
            assert {"name": "sweeps", "mountPath": place} in container["volumeMounts"]
        else:
            assert claims == []
            assert place.startswith("s3://")
            assert {"secretRef": {"name": "tune-jobs-s3"}} in sources
            assert "sweeps" not in volumes


def test_kueue_admits_what_it_is_told_of(manifests: list[dict[str, Any]]) -> None:
    for manifest in manifests:
        labels = manifest["metadata"].get("labels", {})
        queue = labels.get("kueue.x-k8s.io/queue-name")
        # KubeRay gives the jobs of a RayCronJob no label of it.
        assert (queue == "tune-jobs") == (manifest["kind"] in ("RayCluster", "RayJob"))
        scales = manifest["spec"].get("enableInTreeAutoscaling") if manifest["kind"] == "RayCluster" else False
        annotations = manifest["metadata"].get("annotations", {})
        assert (annotations.get("kueue.x-k8s.io/elastic-job") == "true") == bool(scales)
    for job in (one["spec"] for one in of_kind(manifests, "RayJob")):
        assert job["shutdownAfterJobFinishes"] is True
        assert not job["rayClusterSpec"].get("enableInTreeAutoscaling")


@pytest.mark.parametrize(("folder", "kind"), [("sweep", "RayJob"), ("nightly", "RayCronJob")])
def test_a_job_resumes_its_sweep_or_launches_it(folder: str, kind: str) -> None:
    manifests = render(FOLDER / folder, component=FOLDER / "storage-pvc")
    (manifest,) = of_kind(manifests, kind)
    job = manifest["spec"].get("jobTemplate", manifest["spec"])
    assert job["submissionMode"] == "HTTPMode"
    assert job["backoffLimit"] > 0
    commands = re.findall(r"tune-jobs (\w+) ([^;]*); code=\$\?", job["entrypoint"])
    assert [name for name, _ in commands] == ["resume", "launch"]
    given = cli.commands["launch"].make_context("launch", commands[1][1].split()).params
    assert given["address"] == "auto"
    assert given["wait_for_nodes"] > 0
    assert commands[0][1].split()[0] == given["name"]
    head = job["rayClusterSpec"]["headGroupSpec"]["template"]["spec"]
    (volume,) = [one for one in head["volumes"] if one["name"] == "files"]
    (files,) = [
        one for one in of_kind(manifests, "ConfigMap") if one["metadata"]["name"] == volume["configMap"]["name"]
    ]
    assert given["spec"] == "/files/sweep.yaml"
    assert list(files["data"]) == ["sweep.yaml"]
    assert load_spec(FOLDER / folder / "sweep.yaml").algorithm == "ppo"


def test_a_new_version_takes_the_place_of_the_old_ones_cluster_and_service() -> None:
    manifests = render(FOLDER / "service", component=FOLDER / "storage-pvc")
    (deployment,) = of_kind(manifests, "Deployment")
    (cluster,) = of_kind(manifests, "RayCluster")
    told = (ROOT / "docker" / "README.md").read_text().partition("*A new version*")[2].partition("\n- ")[0]
    named = re.findall(
        r"scale deploy/(\S+) --replicas=0|--selector=(\S+)|delete raycluster (\S+)|apply --kustomize (\S+)", told
    )
    label = "app.kubernetes.io/component"
    pod = deployment["spec"]["template"]
    # The sweeps save before their cluster goes; applied, the manifest begins the service again.
    assert ["".join(one) for one in named] == [
        deployment["metadata"]["name"], f"{label}={pod['metadata']['labels'][label]}", cluster["metadata"]["name"],
        str((FOLDER / "service").relative_to(ROOT)),
    ]  # fmt: skip
    assert deployment["spec"]["replicas"] == 1
    (timeout_s,) = re.findall(r"--timeout=(\d+)s", told)
    assert int(timeout_s) > pod["spec"]["terminationGracePeriodSeconds"]


def test_the_service_is_asked_for_what_it_has(storage: str) -> None:
    manifests = render(FOLDER / "service", component=FOLDER / storage)
    (deployment,) = of_kind(manifests, "Deployment")
    (service,) = of_kind(manifests, "Service")
    (cluster,) = of_kind(manifests, "RayCluster")
    spec = deployment["spec"]
    # Two would run one queue.
    assert (spec["replicas"], spec["strategy"]) == (1, {"type": "Recreate"})
    (container,) = spec["template"]["spec"]["containers"]
    program, command, *options = container["command"]
    assert (program, command) == ("tune-jobs", "serve")
    given = serve.make_context("serve", options).params
    assert given["address"] == f"ray://{cluster['metadata']['name']}-head-svc:{PORTS['client']}"
    # There may be no worker.
    assert given["wait_for_nodes"] > 0
    assert (given["host"], given["port"]) == ("0.0.0.0", container["ports"][0]["containerPort"])
    assert given["public_names"] == (service["metadata"]["name"],)
    # With sweeps in a bucket, too, the service has a folder: one pod's.
    (claim,) = [one for one in of_kind(manifests, "PersistentVolumeClaim") if "service" in one["metadata"]["name"]]
    assert claim["spec"]["accessModes"] == ["ReadWriteOnce"]
    volumes = {volume["name"]: volume for volume in spec["template"]["spec"]["volumes"]}
    assert volumes["service"]["persistentVolumeClaim"] == {"claimName": claim["metadata"]["name"]}
    assert {"name": "service", "mountPath": str(given["folder"])} in container["volumeMounts"]
    assert given["drain_s"] < spec["template"]["spec"]["terminationGracePeriodSeconds"]
    assert service["spec"]["selector"] == spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"]
    assert service["spec"]["ports"][0]["targetPort"] == container["ports"][0]["name"]


def test_the_service_waits_for_its_first_token_which_is_made_where_it_waits(tmp_path: Path) -> None:
    (deployment,) = of_kind(render(FOLDER / "service", component=FOLDER / "storage-s3"), "Deployment")
    spec = deployment["spec"]["template"]["spec"]
    (waits,) = spec["initContainers"]
    (container,) = spec["containers"]
    # The same database, in the same folder.
    assert waits["volumeMounts"] == [mount for mount in container["volumeMounts"] if mount["name"] != "sweeps"]
    (database,) = waits["env"]
    assert database in container["env"]
    readme = (ROOT / "docker" / "README.md").read_text()
    (made,) = re.findall(r"exec deploy/(\S+) --container (\S+) --\s+tune-jobs (token make [^`\n#]*)", readme)
    assert made[:2] == (deployment["metadata"]["name"], waits["name"])
    assert made[2].strip().endswith(" --folder /service")
    # As they stand, but for the folder: it waits, a token is made, it ends.
    shell, option, loop = waits["command"]
    folder = tmp_path / "service"
    environment = {**os.environ, "TUNE_JOBS_STORAGE": "s3://sweeps/here", "PATH": f"{BIN}:{os.environ['PATH']}"}
    command = ["tune-jobs", *made[2].replace("/service", str(folder)).split()]
    with subprocess.Popen(
        [shell, option, loop.replace("/service", str(folder))], env=environment, stdout=subprocess.PIPE,
        start_new_session=True,
    ) as waiting:  # fmt: skip
        try:
            deadline = time.monotonic() + 60
            while not (folder / "service.db").exists():
                assert time.monotonic() < deadline
                time.sleep(0.1)
            assert waiting.poll() is None
            assert (
                subprocess.run(command, env=environment, check=False, capture_output=True, timeout=60).returncode == 0
            )
            assert waiting.wait(timeout=60) == 0
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(waiting.pid, signal.SIGKILL)
