"""What `kubectl apply --kustomize` would send, as far as the files here go: no kustomize is needed to look at it.

Read are `resources`, `components`, `patches` (lists of JSON Patch's `add`), `configMapGenerator` of files, `namespace`
and `images`; whatever else a kustomization says is refused, so that nothing goes unread.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import yaml

_READ = {
    "apiVersion", "kind", "resources", "components", "patches", "configMapGenerator", "generatorOptions", "namespace",
    "images",
}  # fmt: skip
_API = {"Kustomization": "kustomize.config.k8s.io/v1beta1", "Component": "kustomize.config.k8s.io/v1alpha1"}


def render(folder: Path, *, component: Path) -> list[dict[str, Any]]:
    """The manifests of a folder.

    Args:
        folder: Where its kustomization.yaml is.
        component: In the place of the component that it names: its variant.

    Raises:
        AssertionError: A file says what is not read here, or what cannot be applied.
    """
    settings = _read(folder, "Kustomization")
    assert len(settings["components"]) == 1, settings["components"]
    assert (folder / settings["components"][0]).resolve().is_dir(), settings["components"]
    assert settings.get("generatorOptions", {"disableNameSuffixHash": True}) == {"disableNameSuffixHash": True}
    manifests = _resources(folder, settings)
    for made in settings.get("configMapGenerator", []):
        assert made.keys() == {"name", "files"}, made
        data = {name: (folder / name).read_text() for name in made["files"]}
        manifests.append({"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": made["name"]}, "data": data})
    variant = _read(component, "Component")
    manifests += _resources(component, variant)
    for patch in variant["patches"]:
        assert patch["target"].keys() == {"kind"}, patch
        for manifest in manifests:
            if manifest["kind"] == patch["target"]["kind"]:
                for operation in yaml.safe_load(patch["patch"]):
                    add(manifest, operation)
    for manifest in manifests:
        manifest["metadata"]["namespace"] = settings["namespace"]
    return manifests


def add(document: Any, operation: dict[str, Any]) -> None:
    """Apply JSON Patch's `add` to a document.

    Raises:
        AssertionError: The operation is another one, or there is no such place.
    """
    assert operation.keys() == {"op", "path", "value"}, operation
    assert operation["op"] == "add", operation
    *parents, last = operation["path"].removeprefix("/").split("/")
    place = document
    for part in parents:
        place = place[int(part)] if isinstance(place, list) else place.get(part)
        assert place is not None, f"{operation['path']}: there is no {part}"
    value = copy.deepcopy(operation["value"])
    if isinstance(place, list):
        assert last == "-", operation
        place.append(value)
    else:
        place[last] = value


def _read(folder: Path, kind: str) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.safe_load((folder / "kustomization.yaml").read_text())
    assert settings.keys() <= _READ, settings.keys() - _READ
    assert (settings["kind"], settings["apiVersion"]) == (kind, _API[kind])
    return settings


def _resources(folder: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    parts = [part for name in settings["resources"] for part in yaml.safe_load_all((folder / name).read_text())]
    # What stands behind an alias is a copy: a patch of one place leaves the other alone.
    return [json.loads(json.dumps(part)) for part in parts]
