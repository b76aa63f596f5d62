"""KubeRay's three kinds as JSON Schemas, with the fields that the manifests may use; pods are Kubernetes' own.

Written down by hand from KubeRay's reference of its fields and the CRD of RayCronJob, v1.6 (Apache-2.0): names, types,
enums, what is required. It is no copy of the CRDs: fields that no manifest uses are left out, so that one of
them is refused here until it is added. Kubernetes' own types are those of the package kubernetes-validate (Apache-2.0).
"""

from __future__ import annotations

import functools
import json
from importlib.resources import files
from typing import Any

from jsonschema import Draft202012Validator  # type: ignore[import-untyped]
from jsonschema.protocols import Validator  # type: ignore[import-untyped]

KUBERNETES = "v1.37.0-local-strict"
KUBERAY = "1.6"
_FOLDER = files("kubernetes_validate") / "kubernetes-json-schema" / KUBERNETES


def _fields(required: tuple[str, ...] = (), **properties: Any) -> dict[str, Any]:
    """An object with these fields and no others."""
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return {**schema, "required": list(required)} if required else schema


def _kubernetes(name: str) -> dict[str, Any]:
    """A type of Kubernetes' core group, by its short name."""
    return {"$ref": f"#/$defs/io.k8s.api.core.v1.{name}"}


STRING = {"type": "string"}
INTEGER = {"type": "integer"}
BOOLEAN = {"type": "boolean"}
STRINGS = {"type": "object", "additionalProperties": STRING}
POD = _kubernetes("PodTemplateSpec")
META = {"$ref": "#/$defs/io.k8s.apimachinery.pkg.apis.meta.v1.ObjectMeta"}

AUTH = _fields(mode={"enum": ["disabled", "token"]}, secretName=STRING, enableK8sTokenAuth=BOOLEAN)
AUTOSCALER = _fields(
    version={"enum": ["v1", "v2"]},
    upscalingMode={"enum": ["Default", "Aggressive", "Conservative"]},
    idleTimeoutSeconds=INTEGER,
    securityContext=_kubernetes("SecurityContext"),
    resources=_kubernetes("ResourceRequirements"),
)
HEAD = _fields(
    ("template",),
    serviceType={"enum": ["ClusterIP", "NodePort", "LoadBalancer"]},
    rayStartParams=STRINGS,
    template=POD,
)
WORKERS = _fields(
    ("groupName", "maxReplicas", "minReplicas", "template"),
    groupName=STRING,
    replicas=INTEGER,
    minReplicas=INTEGER,
    maxReplicas=INTEGER,
    rayStartParams=STRINGS,
    template=POD,
)
CLUSTER = _fields(
    ("headGroupSpec",),
    rayVersion=STRING,
    authOptions=AUTH,
    enableInTreeAutoscaling=BOOLEAN,
    autoscalerOptions=AUTOSCALER,
    headGroupSpec=HEAD,
    workerGroupSpecs={"type": "array", "items": WORKERS},
)
JOB = _fields(
    entrypoint=STRING,
    submissionMode={"enum": ["K8sJobMode", "HTTPMode", "InteractiveMode", "SidecarMode"]},
    backoffLimit=INTEGER,
    shutdownAfterJobFinishes=BOOLEAN,
    ttlSecondsAfterFinished=INTEGER,
    activeDeadlineSeconds={"type": "integer", "minimum": 1},
    rayClusterSpec=CLUSTER,
)
CRON = _fields(
    ("jobTemplate", "schedule"),
    schedule=STRING,
    timeZone={"type": "string", "minLength": 1},
    suspend=BOOLEAN,
    jobTemplate=JOB,
)
SPECS = {"RayCluster": CLUSTER, "RayJob": JOB, "RayCronJob": CRON}
KINDS = {
    "apps/v1 Deployment": "io.k8s.api.apps.v1.Deployment",
    "networking.k8s.io/v1 NetworkPolicy": "io.k8s.api.networking.v1.NetworkPolicy",
    "v1 ConfigMap": "io.k8s.api.core.v1.ConfigMap",
    "v1 PersistentVolumeClaim": "io.k8s.api.core.v1.PersistentVolumeClaim",
    "v1 Service": "io.k8s.api.core.v1.Service",
}


@functools.cache
def _definitions() -> dict[str, Any]:
    definitions: dict[str, Any] = json.loads((_FOLDER / "_definitions.json").read_text())["$defs"]
    return definitions


def validator(manifest: dict[str, Any]) -> Validator:
    """What checks a manifest of its kind.

    Raises:
        KeyError: The kind, with its version, is none that the manifests use.
    """
    version, kind = manifest["apiVersion"], manifest["kind"]
    if version == "ray.io/v1":
        schema = _fields(
            ("apiVersion", "kind", "metadata", "spec"), apiVersion=STRING, kind=STRING, metadata=META, spec=SPECS[kind]
        )
    else:
        schema = {"$ref": f"#/$defs/{KINDS[f'{version} {kind}']}"}
    return Draft202012Validator({**schema, "$defs": _definitions()})


def problems(manifest: dict[str, Any]) -> list[str]:
    """What is wrong with a manifest, each with its place; no name of a field that is unknown goes through."""
    found = validator(manifest).iter_errors(manifest)
    return [f"{'.'.join(str(part) for part in error.absolute_path)}: {error.message[:300]}" for error in found]
