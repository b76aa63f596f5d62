from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import (
    IMAGES,
    make_image_policy,
    make_module_portable,
    make_portable,
    register_test_envs,
)

from policies.acting.load import load_policy
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError
from policies.portable.file import (
    Layer,
    PolicyNetwork,
    PortablePolicy,
    describe_space,
    read_policy,
    save_policy,
    space_from_description,
)
from policies.portable.network import ConvLayer
from tests.narrowing import present
from tests.rounding import assert_rounded, dense

register_test_envs()
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1", "TestPushes-v0", "TestWalk-v0"])
def test_what_is_saved_is_what_is_read(env_id: str, tmp_path: Path) -> None:
    saved = make_portable(env_id, hidden=(5, 7), activation="elu")
    path = save_policy(saved, tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["policy.json", "policy.safetensors"]
    for place in (tmp_path, path, tmp_path / "policy.safetensors", str(path)):
        read = read_policy(cast("Path", place))
        for field in dataclasses.fields(saved):
            if field.name != "network":
                assert getattr(read, field.name) == getattr(saved, field.name)
        assert read.network.kind == saved.network.kind
        for ours, theirs in zip(read.network.layers, saved.network.layers, strict=True):
            assert ours.activation == theirs.activation
            for name in ("weight", "bias"):
                array = getattr(ours, name)
                assert array.dtype == np.float32
                np.testing.assert_array_equal(array, getattr(theirs, name))


@pytest.mark.parametrize("make", [make_image_policy, make_module_portable])
def test_all_parts_of_a_network_are_read_as_they_were_saved(
    make: Callable[..., PortablePolicy], tmp_path: Path
) -> None:
    saved = make()
    save_policy(saved, tmp_path)
    read = read_policy(tmp_path)
    assert read.observation_space == saved.observation_space
    ours, theirs = read.network.parts(), saved.network.parts()
    assert list(ours) == sorted(theirs) if make is make_module_portable else list(ours) == list(theirs)
    for place, arrays in theirs.items():
        for one, other in zip(ours[place], arrays, strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
    assert read.network.scale == saved.network.scale
    for layer, saved_layer in zip(read.network.conv, saved.network.conv, strict=True):
        assert (layer.stride, layer.activation) == (saved_layer.stride, saved_layer.activation)
    if saved.network.module is not None:
        assert present(read.network.module).class_path == saved.network.module.class_path
        assert present(read.network.module).model_config == saved.network.module.model_config
    else:
        assert present(read.network.normalization).clip == present(saved.network.normalization).clip


def test_files_of_format_1_act_as_they_did() -> None:
    """Written before there were convolutions and statistics."""
    policy = load_policy(Path(__file__).parent / "samples" / "policy_format_1")
    observations = np.array([[0.1, -0.2, 0.03, 0.4], [-1.0, 0.5, -0.2, -0.7]])
    expected = [[0.17224079370498657, 0.17183804512023926], [-0.18863928318023682, 0.07189814746379852]]
    sizes, num_roundings = dense(cast("Any", policy).portable.network.layers, observations)
    assert_rounded(cast("Any", policy).outputs(observations), expected, sizes=sizes, num_roundings=num_roundings)
    np.testing.assert_array_equal(policy.act(observations), [0, 1])
    assert policy.observation_space == gym.make("CartPole-v1").observation_space


def test_equal_bounds_are_one_number() -> None:
    description = describe_space(IMAGES)
    assert (description["low"], description["high"]) == (0, 255)
    assert len(json.dumps(description)) < 100
    assert describe_space(gym.spaces.Box(-np.inf, np.inf, (3,)))["low"] == "-inf"


def _network(**changes: Any) -> PortablePolicy:
    policy = make_image_policy()
    return dataclasses.replace(policy, network=dataclasses.replace(policy.network, **changes))


def _conv(**changes: Any) -> dict[str, tuple[ConvLayer, ConvLayer]]:
    first, second = make_image_policy().network.conv
    return {"conv": (first, dataclasses.replace(second, **changes))}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"conv": make_image_policy().network.conv[:1]}, "its input has 100 numbers"),
        ({"conv": make_image_policy().network.conv[::-1]}, "convolution 0 has weights"),
        (_conv(stride=0), "convolution 1 .* stride 0"),
        (_conv(activation="exec"), "activation 'exec'"),
        (_conv(bias=np.zeros(4, np.float32)), "convolution 1 has a bias"),
        (_conv(weight=np.zeros((3, 5, 6, 6), np.float32)), "kernels of 6 x 6, but its input has only 5 x 4"),
        ({"conv": ()}, "its input has 260 numbers"),
        (
            {
                "normalization": dataclasses.replace(
                    present(make_image_policy().network.normalization), std=cast("Any", np.ones(3))
                )
            },
            r"a std of shape \(3,\)",
        ),
        ({"kind": "module"}, "no module"),
        ({"module": make_module_portable().network.module}, "has a module"),
        ({"kind": "module", "module": make_module_portable().network.module}, "2 layers, but takes none"),
    ],
)
def test_parts_that_form_no_network_are_not_saved(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=words):
        save_policy(_network(**changes), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_policy_of_a_class_that_is_not_allowed_is_read_but_does_not_act(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    save_policy(make_module_portable(), tmp_path)
    with pytest.raises(SpecError, match="no_such_package"):
        load_policy(tmp_path)


def test_transposed_weights_are_saved_as_what_they_are(tmp_path: Path) -> None:
    policy = make_portable("CartPole-v1", hidden=())
    weight = np.asfortranarray(policy.network.layers[0].weight)
    view = Layer(weight, policy.network.layers[0].bias)
    save_policy(dataclasses.replace(policy, network=PolicyNetwork("categorical", (view,))), tmp_path)
    np.testing.assert_array_equal(read_policy(tmp_path).network.layers[0].weight, weight)


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Box(np.array([-4.8, -np.inf], np.float32), np.array([np.inf, 0.1], np.float32)),
        gym.spaces.Box(-1e-300, 1e300, (3,), np.float64),
        gym.spaces.Box(-np.inf, np.inf, (3,), np.float32),
        gym.spaces.Box(np.array([-1, 0.5], np.longdouble), np.array([np.inf, 1], np.longdouble), dtype=np.longdouble),
        gym.spaces.Box(0, 255, (4, 5, 3), np.uint8),
        gym.spaces.Box(np.array([[0, 0], [0, 1]], np.uint8), np.full((2, 2), 9, np.uint8), (2, 2), np.uint8),
        gym.spaces.Discrete(5),
        gym.spaces.Discrete(3, start=-2),
    ],
)
def test_spaces_survive_json(space: gym.spaces.Box | gym.spaces.Discrete[Any]) -> None:
    text = json.dumps(describe_space(space), allow_nan=False)
    assert space_from_description(json.loads(text)) == space


@pytest.mark.parametrize(
    "description",
    [
        {"type": "box", "shape": [2], "low": [0], "high": [1, 1], "dtype": "float32"},
        {"type": "box", "shape": [1], "low": [0], "high": ["big"], "dtype": "float32"},
        {"type": "box", "shape": [1], "low": [0], "high": [1]},
        {"type": "box", "shape": [1], "low": [0], "high": [1], "dtype": "no such"},
        {"type": "discrete", "n": 0},
        {"type": "tuple"},
        {},
    ],
)
def test_a_description_of_no_space_is_refused(description: dict[str, Any]) -> None:
    with pytest.raises(CheckpointError):
        space_from_description(description)


def test_odd_metadata_does_not_spoil_the_json(tmp_path: Path) -> None:
    training = {
        "score": math.nan,
        "lr": np.float32(0.5),
        "sizes": (64, 64),
        "where": tmp_path,
        "steps": np.int64(3),
    }
    save_policy(dataclasses.replace(make_portable("CartPole-v1"), training=training), tmp_path)
    text = (tmp_path / "policy.json").read_text()
    assert "NaN" not in text
    expected = {"score": None, "lr": 0.5, "sizes": [64, 64], "where": str(tmp_path), "steps": 3}
    assert read_policy(tmp_path).training == expected


def test_files_may_be_renamed_together(tmp_path: Path) -> None:
    save_policy(make_portable("CartPole-v1"), tmp_path, stem="best")
    for suffix in (".json", ".safetensors"):
        (tmp_path / f"best{suffix}").rename(tmp_path / f"mine.v2{suffix}")
    assert read_policy(tmp_path / "mine.v2.json").env_id == "CartPole-v1"


def _edit(folder: Path, **changes: Any) -> None:
    path = folder / "policy.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_missing_files_are_not_found(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match=r"policy\.json") as caught:
        read_policy(tmp_path)
    assert caught.value.exit_code == 4
    with pytest.raises(NotFoundError, match="nowhere"):
        read_policy(tmp_path / "nowhere")
    for missing in ("policy.json", "policy.safetensors"):
        save_policy(make_portable("CartPole-v1"), tmp_path)
        (tmp_path / missing).unlink()
        with pytest.raises(NotFoundError, match=missing):
            read_policy(tmp_path)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "policy.pkl").write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"neither \.json nor \.safetensors"):
        read_policy(tmp_path / "policy.pkl")


def test_a_changed_or_cut_weights_file_fails_its_hash(tmp_path: Path) -> None:
    save_policy(make_portable("CartPole-v1"), tmp_path)
    weights = tmp_path / "policy.safetensors"
    content = weights.read_bytes()
    for altered in (content[:-4], content[:-1] + bytes([content[-1] ^ 1]), b""):
        weights.write_bytes(altered)
        with pytest.raises(CheckpointError, match=r"policy\.safetensors has SHA-256"):
            read_policy(tmp_path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format_version": 3}, "format version 3"),
        (
            {"network": {"kind": "categorical", "activations": ["tanh", "tanh"]}},
            "does not describe the tensors",
        ),
        ({"network": {"kind": "categorical", "activations": ["tanh"] * 4}}, "layers.3.weight"),
        (
            {"network": {"kind": "categorical", "activations": ["tanh", "exec", "linear"]}},
            "activation 'exec'",
        ),
        ({"network": {"kind": "gaussian", "activations": ["tanh", "tanh", "linear"]}}, "gaussian"),
        ({"network": {"kind": "magic", "activations": ["tanh", "tanh", "linear"]}}, "magic"),
        ({"network": None}, "cannot be read"),
        ({"action_transform": "square"}, "square"),
        ({"action_space": {"type": "discrete", "n": 3, "start": 0}}, "2 outputs, but its actions need 3"),
        ({"action_space": "left"}, "cannot be read"),
        (
            {
                "observation_space": {
                    "type": "box",
                    "shape": [3],
                    "low": [0] * 3,
                    "high": [1] * 3,
                    "dtype": "float32",
                }
            },
            "its input has 3 numbers",
        ),
    ],
)
def test_a_description_that_does_not_fit_is_refused(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    save_policy(make_portable("CartPole-v1"), tmp_path)
    _edit(tmp_path, **changes)
    with pytest.raises(CheckpointError, match=words) as caught:
        read_policy(tmp_path)
    assert str(tmp_path) in caught.value.message


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "\xff", '{"format_version": 1}'])
def test_json_of_something_else_is_refused(text: str, tmp_path: Path) -> None:
    save_policy(make_portable("CartPole-v1"), tmp_path)
    (tmp_path / "policy.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(CheckpointError, match=r"policy\.(json|safetensors)"):
        read_policy(tmp_path)


def test_layers_that_form_no_network_are_not_saved(tmp_path: Path) -> None:
    policy = make_portable("CartPole-v1")
    for layers in ((), policy.network.layers[:-1], policy.network.layers[::-1]):
        with pytest.raises(CheckpointError):
            save_policy(dataclasses.replace(policy, network=PolicyNetwork("categorical", layers)), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_save_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_policy(make_portable("CartPole-v1", seed=1), tmp_path)
    replace = type(tmp_path).replace

    def fail_at_json(self: Path, target: Path) -> Path:
        if target.suffix == ".json":
            raise OSError(28, os.strerror(28))
        return replace(self, target)

    monkeypatch.setattr(type(tmp_path), "replace", fail_at_json)
    with pytest.raises(CannotRunError, match="No space left"):
        save_policy(make_portable("CartPole-v1", seed=2), tmp_path)
    with pytest.raises(CheckpointError, match="SHA-256"):
        read_policy(tmp_path)


def test_reading_needs_neither_ray_nor_torch(tmp_path: Path) -> None:
    save_policy(make_portable("CartPole-v1"), tmp_path)
    code = (
        "import sys; from policies.acting.load import load_policy; import policies.acting.evaluate\n"
        f"load_policy({str(tmp_path)!r}).act([0, 0, 0, 0])\n"
        "print([name for name in ('ray', 'torch', 'pandas', 'matplotlib', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"
