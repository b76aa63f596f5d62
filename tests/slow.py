"""Tests that `make test` leaves out, and says so, as all of them take longer than the 25 minutes that it may take.

Most take at least half a minute on two cores beside the others, and another test, which is named, looks at most of the
same. `make test-slow` runs them alone.
"""

from __future__ import annotations

import os

import pytest

VARIABLE = "TUNE_JOBS_SLOW"
_PPO = "the same, ppo, and the tests of its file that updates of DQN are RLlib's"
_FOLDERS = "the same, folders, and within-packages"
_LEARN = "`make learn` trains every preset over five seeds"

SLOW = {
    "tests/cluster/test_autoscaled_cluster.py":
        "tests/unit/test_waiting_for_nodes.py, and tests/unit/test_autoscaler.py",
    "tests/cluster/test_cluster.py::test_a_trial_goes_on_elsewhere_when_its_node_is_lost[rllib-crash]":
        "the same, packed",
    "tests/cluster/test_cluster.py::test_a_trial_goes_on_elsewhere_when_its_node_is_lost[packed-drain]":
        "the same, rllib",
    "tests/cluster/test_detached_sweeps.py": "tests/unit/test_detached.py, and tests/unit/test_jobs.py",
    "tests/cluster/test_joining_nodes.py": "tests/ray/test_pack_driver.py",
    "tests/integration/test_makefile.py::test_a_broken_environment_is_mended_and_a_sound_one_left_alone[no Python]":
        "the same, no pip",
    "tests/integration/test_own_packages.py::test_modules_of_both_are_found[tune_jobs-packages]": _FOLDERS,
    "tests/integration/test_own_packages.py::test_modules_of_both_are_found[theirs-packages]": _FOLDERS,
    "tests/integration/test_own_packages.py::test_modules_of_both_are_found[within-folders]":
        "the same, within-packages",
    "tests/integration/test_service_kills.py::test_whoever_is_killed_each_sweep_runs_to_its_end_once[postgresql]":
        "the same, sqlite, and `make kills`",
    "tests/learning/test_learning.py::test_dqn_learns_cartpole": _LEARN,
    "tests/learning/test_learning.py::test_ppo_learns_pendulum": _LEARN,
    "tests/learning/test_packed_dqn_learning.py::test_a_pack_of_dqn_trials_solves_cartpole": _LEARN,
    "tests/learning/test_packed_learning.py::test_a_pack_learns_as_rllib_does": "tests/ray/test_packed_ppo.py",
    "tests/package/test_docker.py": "tests/package/test_docker_files.py, and test_wheel.py for what is installed",
    "tests/ray/test_chosen_points.py::test_it_is_chosen_if_it_is_the_best_and_confirmed": "the others of its file",
    "tests/ray/test_chosen_points.py::test_its_values_act_in_each_of_its_seeds_and_the_others_stay_as_they_are[rllib]":
        "the same, packed",
    "tests/ray/test_chosen_points.py::test_tpe_goes_on_behind_it_with_its_own_draws_and_is_told_of_it":
        "tests/unit/test_chosen_point.py, and tests/unit/test_search_methods.py",
    "tests/ray/test_confirming.py::test_an_interrupted_race_goes_on_as_it_would_have": "tests/ray/test_more_seeds.py",
    "tests/ray/test_confirming.py::test_it_is_left_out_where_it_is_off_or_somebody_replicates":
        "tests/unit/test_confirm.py",
    "tests/ray/test_confirming.py::test_more_samples_are_confirmed_anew_and_old_sweeps_are_left_alone":
        "tests/ray/test_more_seeds.py",
    "tests/ray/test_ends_in_order.py::test_parts_of_ray_that_die_one_after_the_other": "tests/ray/test_ray_watch.py",
    "tests/ray/test_faulty_envs.py::test_faulty_trials_fail_alone_and_the_sweep_is_read_retried_and_resumed[rllib]":
        "the same, packed",
    "tests/ray/test_folders_of_our_names.py": "tests/package/test_wheel.py",
    "tests/ray/test_learning_from_spaces.py::test_a_pack_learns_from_it[multi-discrete-dqn]": "the same, ppo",
    "tests/ray/test_learning_from_spaces.py::test_a_pack_learns_from_it[multi-binary-dqn]": "the same, ppo",
    "tests/ray/test_learning_from_spaces.py::test_a_pack_learns_from_it[matrix of whole numbers-dqn]": "the same, ppo",
    "tests/ray/test_learning_from_spaces.py::test_a_pack_learns_from_it[infinite bounds-dqn]": "the same, ppo",
    "tests/ray/test_learning_from_spaces.py::test_a_pack_learns_from_it[tuple-dqn]": "the same, ppo",
    "tests/ray/test_learning_of_actions.py::test_a_trial_of_rllibs_learns_it[dqn-mask in infos]":
        "the same in a pack, and tests/ray/test_masked_networks.py",
    "tests/ray/test_length_of_training.py::test_each_trial_ends_at_its_own_length[rllib]": "the same, packed",
    "tests/ray/test_more_seeds.py::test_leading_settings_get_fresh_seeds_and_train_to_the_end[rllib-hyperband]":
        "the same, packed",
    "tests/ray/test_more_seeds.py::test_points_that_tpe_chose_are_trained_again":
        "the others of its file, and tests/unit/test_search_methods.py",
    "tests/ray/test_own_envs.py::test_what_a_process_can_hold_once_trains[rllib-dqn]":
        "the same, packed, and tests/unit/test_own_process.py",
    "tests/ray/test_pack_interruption.py::test_members_go_on_from_their_checkpoints_after_a_kill_and_an_interruption":
        "`make kills`, and tests/ray/test_interruption.py",
    "tests/ray/test_packed_images.py::test_both_engines_learn_to_look_at_a_member_of_stacked_observations[ppo-TestMaskedBeside-v0]":
        "the same, TestBeside-v0",
    "tests/ray/test_packed_images.py::test_both_engines_learn_to_look_at_a_member_of_stacked_observations[dqn-TestMaskedBeside-v0]":
        "the same, TestBeside-v0",
    "tests/ray/test_packed_images.py::test_a_trial_of_rllibs_learns_to_look_at_what_is_no_plain_image[dqn-TestMaskedShades-v0]":
        _PPO,
    "tests/ray/test_packed_images.py::test_a_trial_of_rllibs_learns_to_look_at_what_is_no_plain_image[dqn-TestMaskedBeside-v0]":
        _PPO,
    "tests/ray/test_packed_images.py::test_a_trial_of_rllibs_learns_to_look_at_what_is_no_plain_image[dqn-TestPair-v0]":
        _PPO,
    "tests/ray/test_packed_images.py::test_a_pack_learns_to_look[dqn-TestMaskedShades-v0]": _PPO,
    "tests/ray/test_packed_images.py::test_a_pack_learns_to_look[dqn-TestBits-v0]": _PPO,
    "tests/ray/test_packed_images.py::test_a_pack_learns_to_look[dqn-TestMaskedBeside-v0]": _PPO,
    "tests/ray/test_packed_images.py::test_a_pack_learns_to_look[dqn-TestPair-v0]": _PPO,
    "tests/ray/test_packs.py::test_members_of_a_pack_that_dies_again_go_on_alone": "tests/ray/test_pack_driver.py",
    "tests/ray/test_programs_for_rllib.py::test_it_finds_an_atari_game_in_a_fresh_process[PongNoFrameskip-v4]":
        "the same, ALE/Pong-v5",
    "tests/ray/test_random_play.py": "tests/integration/test_baseline_sweeps.py",
    "tests/ray/test_repetitions.py::test_a_trial_comes_to_the_same_by_itself[rllib]": "the same, packed",
    "tests/ray/test_restore.py::test_env_runners_are_restored_where_there_are_cpus_for_them_and_for_one_more[ppo-enough]":
        "the same, dqn",
    "tests/ray/test_restore.py::test_env_runners_are_restored_where_there_are_cpus_for_them_and_for_one_more[dqn-few]":
        "the same, ppo",
    "tests/ray/test_resumed_rewards.py::test_the_statistics_of_a_resumed_trial_are_of_all_its_env_steps[rllib]":
        "the same, packed",
    "tests/ray/test_resumed_rewards.py::test_where_episodes_are_alike_a_pack_goes_on_as_if_it_had_not_been_interrupted":
        "the other test of its file, packed",
    "tests/ray/test_rllib_engine.py::test_dqn_fills_its_replay_buffer_again[an env runner]":
        "the same, itself, and the next test of its file",
    "tests/ray/test_schedulers.py::test_a_trial_without_a_finite_score_never_runs_on[hyperband]":
        "the same, asha, and tests/ray/test_hyperband.py",
    "tests/ray/test_schedulers.py::test_every_scheduler_runs_to_the_end[hyperband]": "tests/ray/test_hyperband.py",
    "tests/ray/test_search.py::test_tpe_runs_as_many_trials_at_once_as_the_machine_allows_and_goes_on_when_extended":
        "tests/unit/test_pack_sizes.py, and tests/unit/test_search_methods.py",
    "tests/ray/test_search.py::test_a_population_that_is_stopped_goes_on_with_its_newest_values[rllib]":
        "the same, packed",
    "tests/ray/test_search_schedulers.py::test_a_replayed_schedule_gives_what_the_population_gave_to_the_bit[cartpole-dqn]":
        "the same, cartpole-ppo",
}  # fmt: skip
"""By node id, or by file: what is looked at instead each time."""


def choose(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip the slow tests; or leave them alone, if the variable says `only`."""
    slow = [item for item in items if item.nodeid in SLOW or item.nodeid.partition("::")[0] in SLOW]
    if os.environ.get(VARIABLE) == "only":
        config.hook.pytest_deselected(items=[item for item in items if item not in slow])
        items[:] = slow
        return
    for item in slow:
        item.add_marker(pytest.mark.skip(reason="slow: `make test-slow` runs it"))
