"""Names of other tuners, and names in a place that is not theirs, lead to the field that is meant."""

import json
from typing import Any

import pytest
from pydantic import BaseModel
from spec_errors import errors

from policies.errors import SpecError
from tune_jobs.spec.other_names import MEANT, meant_by
from tune_jobs.spec.plain_data import to_plain
from tune_jobs.spec.sections import SearchSpec, StopSpec, SweepFields
from tune_jobs.spec.yaml import parse_yaml

FIELDS: dict[str, type[BaseModel]] = {"": SweepFields, "search": SearchSpec, "stop": StopSpec}


def test_the_table_names_fields_that_exist_and_none_that_is_one_itself() -> None:
    for section, names in MEANT.items():
        fields = FIELDS[section].model_fields
        for name, meant in names.items():
            assert name not in fields
            if " " in meant:
                continue
            head, _, rest = meant.partition(".")
            assert head in fields, name
            if rest:
                inner: Any = fields[head].annotation
                assert rest in inner.model_fields, name


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        # By letters it would be training_return, and 20 of that ends CartPole's trials at once.
        ({"stop": {"training_iteration": 20}}, "no field 'training_iteration' here. Did you mean 'num_iterations'?"),
        ({"stop": {"timesteps_total": 9}}, "Did you mean 'num_env_steps'?"),
        ({"num_seeds": 5}, "Did you mean 'seeds_per_point'?"),
        ({"seeds": 5}, "Did you mean 'seeds_per_point'?"),
        ({"sampler": "tpe"}, "Did you mean 'search'?"),
        ({"pruner": "asha"}, "Did you mean 'scheduler'?"),
        ({"n_trials": 5}, "Did you mean 'num_samples'?"),
        ({"max_concurrent_trials": 2}, "Did you mean 'resources.max_concurrent'?"),
        ({"parameters": {}}, "Did you mean 'space'?"),
        ({"metric": "x"}, "there is no field 'metric' here. A setting is judged by its evaluation returns"),
        ({"config": {}}, "no field 'config' here. Values that are fixed go under hyperparams, and what is searched"),
        # Where it stands in another section of ours, it is named with it.
        ({"every_iterations": 3}, "Did you mean evaluation.every_iterations or checkpoints.every_iterations?"),
        ({"lr": 3}, "Did you mean hyperparams.lr or space.lr?"),
        ({"learning_rate": 1e-3}, "SB3's learning_rate is hyperparams.lr here; what is searched goes under space."),
        (
            {"batch_size": 64},
            (
                "SB3's batch_size is hyperparams.minibatch_size here (ppo); SB3's batch_size is "
                "hyperparams.train_batch_size here (dqn); what is searched goes under space."
            ),
        ),
        ({"n_timesteps": 64}, "For SB3's n_timesteps, of RL Zoo: set stop.num_env_steps"),
        ({"net_arch": [64]}, "SB3's net_arch is hyperparams.hidden_sizes here"),
        ({"hyperparams": {"frame_stack": 4}}, "ppo has no hyperparameter 'frame_stack'. Did you mean env.frame_stack?"),
        ({"hyperparams": {"num_gpus": 1}}, "ppo has no hyperparameter 'num_gpus'. Did you mean resources.num_gpus?"),
        ({"hyperparams": {"seed": 1}}, "seed is a field of the whole sweep: write it at the top level."),
        # What is near to a field is still told by its letters.
        ({"num_sample": 5}, "Did you mean 'num_samples'?"),
        ({"hyperparams": {"epochs": 5}}, "Did you mean 'num_epochs'?"),
    ],
)  # fmt: skip
def test_a_name_leads_to_what_is_meant(changes: dict[str, Any], told: str) -> None:
    assert told in errors(**changes)


def test_a_name_that_nobody_knows_has_no_answer() -> None:
    assert meant_by([], "colour") == meant_by(["stop"], "learning_rate") == meant_by(["search"], "sampler") == ""


def test_json_that_is_indented_by_tabs_is_read() -> None:
    data = {"env": {"id": "CartPole-v1", "args": {"text": "a\tb"}}, "algorithm": "ppo"}
    for text in (json.dumps(data, indent="\t"), "\n" + json.dumps(data).replace(" ", "\t")):
        assert parse_yaml(text, "x.json") == data
    # What is wrong in it is told with its own place; what is no JSON, as YAML.
    with pytest.raises(SpecError, match="line 2, column 2: the key 'a' occurs twice"):
        parse_yaml('{"a": 1,\n\t"a": 2}', "x.json")
    with pytest.raises(SpecError, match="there is a tab where YAML takes only spaces"):
        parse_yaml("{a: 1,\n\tb: [\t}", "x.yaml")


def test_a_key_that_is_there_as_a_number_and_as_a_text_loses_no_value() -> None:
    with pytest.raises(SpecError, match=r"sweep: env\.args\.rewards: has the key '1' twice, as a number and as a text"):
        to_plain({"env": {"args": {"rewards": {1: "a", "1": "b"}}}}, "sweep")


def test_a_domain_in_a_list_is_told_to_stand_alone() -> None:
    told = errors(space={"gamma": [{"choice": [0.9, 0.99]}]})
    assert "space.gamma: [{'choice': [0.9, 0.99]}] is a list of one domain: write {'choice': [0.9, 0.99]} alone" in told
