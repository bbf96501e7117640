"""Which tests judge which module of what keeps robots safe, judges or identifies, in the mutation run."""

from __future__ import annotations

__all__ = ["MODULES"]

BARRIERS = ("test_stacks_of_functions.py", "test_barriers.py", "test_filter_recorded.py", "test_filter_invariance.py")
EQUATIONS = ("test_equation_stack.py",)
VERDICTS = (
    "test_filter_recorded.py",
    "test_filter_edges.py",
    "test_filter_inputs.py",
    "test_filter_verdicts.py",
)
SLOPES = "test_barriers.py::test_gradient_is_the_derivative"
MARGIN = "test_a_margin_with_ordered_errors_is_the_one_that_sorts"
ALL_KINDS = "-test_filter_promises.py::test_every_kind_of_problem_is_among_them"
PROMISES = ("test_filter_promises.py", ALL_KINDS)
"""Without what counts its own problems."""
POINT = ("../point/test_point_filter.py",)
BATCH = ("test_batch_one_by_one.py", "test_batch.py")
CHECK = ("test_check_parts.py", "test_check_edges.py")
"""Without what drives whole filters, ten seconds at a time."""
ROLLOUT = (
    "test_swept.py",
    "test_rollout_barrier.py",
    "-test_rollout_barrier.py::test_what_is_thinner_than_a_tick_is_not_jumped_over",
    "-test_rollout_barrier.py::test_with_relative_degree_two_nothing_is_hit_and_nothing_relaxed",
    "-test_rollout_barrier.py::test_a_planar_quadrotor_is_kept_off_by_its_tilt",
)
PENDING = ("test_pending_actions.py", "-test_pending_actions.py::test_a_delay_that_is_known_costs_nothing")
DRIVES = (
    "test_log_margin.py",
    "-test_log_margin.py::test_fresh_drives_are_covered_as_often_as_stated_where_steps_taken_for_exchangeable_are_not",
)
CHANGES = ("../changes/test_margin_changes.py", "../changes/test_offers_to_nodes.py")
WATCHED = ("test_watched_margin.py", "test_filter_edges.py", *CHANGES)
WAY_OUT = ("test_way_out.py", "-test_way_out.py::test_a_car_next_to_an_obstacle_gets_out")
STRANGERS = (
    "test_strangers.py",
    "-test_strangers.py::test_the_filters_own_process_refuses_a_stranger",
    "-test_strangers.py::test_the_command_refuses_a_stranger",
    "-test_strangers.py::test_wrong_pairs_are_refused_by_the_command",
)
"""Without what starts another process: it has no mutant."""
STAMPS = (
    "../bus/test_stamp.py",
    "-../bus/test_stamp.py::test_a_message_gone_astray_is_not_heard_and_that_is_told",
    "-../bus/test_stamp.py::test_a_question_gone_astray_is_not_answered_nor_an_answer_taken",
)
"""Without what opens sessions."""
CERTIFICATES = (
    "../bus_security/test_conditions_by_hand.py",
    "../bus/test_authority_by_hand.py",
    "../bus_security/test_authority.py",
    "-../bus_security/test_authority.py::test_a_process_with_half_an_identity_does_not_start",
    "../bus_security/test_signed_requests.py",
)
"""Without what starts processes."""
DOOR = "../hostile/test_joining.py::"
DOORKEEPER = (
    "../bus_security/test_doorkeeper.py",
    f"{DOOR}test_sockets_are_looked_for_by_several_threads_at_once",
    f"{DOOR}test_every_socket_is_found_whatever_its_number",
)
EDGES = "../diagnosis/test_where.py::test_edges_are_round_ordered_and_hold_all_values"
REQUESTS = ("../bus/test_requests.py", "../bus_security/test_conditions_by_hand.py")
MODULES = {
    "decision": (
        *VERDICTS,
        "test_filter_invariance.py",
        "test_on_its_way.py",
        "test_searched.py",
    ),
    "search": (
        "../internals/safety/test_search.py",
        *VERDICTS,
        *PROMISES,
        "test_filter_invariance.py",
    ),
    "conditions": (
        "test_filter_conditions.py",
        "test_on_its_way.py",
        "test_functions_of_ones_own.py",
        *VERDICTS,
    ),
    "not_finite": ("test_tangent.py",),
    "tangent": ("test_tangent.py", "test_filter_conditions.py", *VERDICTS),
    "equations.chain_rule": ("test_prediction.py",),
    "equations.slopes": EQUATIONS,
    "equations.rows": EQUATIONS,
    "equations.plain_rows": (*EQUATIONS, "test_remembered.py"),
    "equations.many_rows": EQUATIONS,
    "least_unsafe": (
        "test_least_unsafe.py",
        "test_highest.py",
        "test_filter_edges.py",
        "test_tangent.py",
        "test_filter_recorded.py",
    ),
    "retreat": ("test_tangent.py",),
    "searched": ("test_searched.py",),
    "lattice": ("test_highest.py",),
    "highest": ("test_highest.py", "test_least_unsafe.py"),
    "inputs": ("test_filter_conditions.py", "test_filter_inputs.py", "test_isolation.py"),
    "quadratic_program": ("test_quadratic_program.py", "test_nearest.py"),
    "nearest": ("test_nearest.py", "test_quadratic_program.py"),
    "program_rows": ("test_nearest.py", "test_quadratic_program.py"),
    "margins_in_force": ("test_stacks_of_functions.py", "test_log_margin.py", "test_filter_inputs.py"),
    "equation_barrier": EQUATIONS,
    "stacks": (*EQUATIONS, "test_remembered.py", "test_log_margin.py"),
    "many_barriers": (*EQUATIONS, *BATCH),
    "robots.car.barriers": ("test_towed_reach.py", *EQUATIONS, *BARRIERS),
    "robots.car.swept": ("test_towed_reach.py", *EQUATIONS, *BARRIERS),
    "robots.car.many_barriers": (*EQUATIONS, *BATCH),
    "affine_motion": ("test_stacks_of_functions.py", *VERDICTS),
    "remembered": ("test_remembered.py", *BARRIERS),
    "solution": ("test_quadratic_program.py", *VERDICTS),
    "verdict": VERDICTS,
    "braking": BARRIERS,
    "barrier": ("test_stacks_of_functions.py", "test_barriers.py", "test_functions_of_ones_own.py"),
    "speed_barrier": (f"{SLOPES}[SpeedBarrier]", *BARRIERS),
    "function_barrier": (
        "test_functions_of_ones_own.py",
        f"{SLOPES}[FunctionBarrier]",
        "test_stacks_of_functions.py",
        "test_barriers.py",
        "test_filter_inputs.py",
    ),
    "corridor_barrier": ("test_barriers.py",),
    "swept": ("test_swept.py",),
    "differences": ("test_prediction.py", "test_functions_of_ones_own.py"),
    "higher_order_barrier": ("test_barriers.py", "test_functions_of_ones_own.py"),
    "stopping_barrier": POINT,
    "stopping_walk": POINT,
    "margin": ("test_margin_conformal.py", *DRIVES, f"../fleet_process/test_fast_paths.py::{MARGIN}"),
    "batch": BATCH,
    "many_predictions": (*BATCH, "../point/test_point_filter.py"),
    "many_stopping": POINT,
    "batch_nearest": ("test_nearest.py", *BATCH),
    "batch_search": ("test_batch_search.py", "../internals/safety/test_batch_search.py", *BATCH),
    "prediction": (
        "test_functions_of_ones_own.py",
        "test_prediction.py",
        "test_stacks_of_functions.py",
        "test_isolation.py",
        "test_filter_invariance.py",
        "test_on_its_way.py",
        *VERDICTS,
    ),
    "safety_filter": (
        "test_functions_of_ones_own.py",
        "test_strangers.py",
        "test_isolation.py",
        "../operations/test_stop_orders.py",
        *VERDICTS,
    ),
    "settings": ("test_filter_settings.py", *STRANGERS),
    "shipped": ("../services/test_shipped.py", "test_filter_settings.py", "test_run_calibration.py"),
    "compatibility": ("test_strangers.py", "test_functions_of_ones_own.py"),
    "finite_clock": ("test_filter_edges.py",),
    "numbers_returned": ("test_isolation.py", "test_filter_inputs.py"),
    "gymnasium_wrapper": ("test_gymnasium_filter.py",),
    "scene": ("test_towed_reach.py",),
    "scenes": ("test_towed_reach.py", "test_strangers.py", *POINT),
    "robots.car.reversed_way": ("test_towed_reach.py",),
    "robots.car.towed_reach": ("test_towed_reach.py",),
    "calibration": ("test_margin_conformal.py", *DRIVES, "test_run_calibration.py", "test_margin_period.py"),
    "run_calibration": ("test_run_calibration.py", "test_log_margin.py", "test_strangers.py"),
    "recorded": ("test_theory_command.py", "test_margin_period.py"),
    "ceiling": ("test_watched_margin.py", *DRIVES),
    "drive_calibration": DRIVES,
    "drive_heights": ("test_watched_margin.py", "test_margin_period.py"),
    "watched_margin": WATCHED,
    "margin_change": CHANGES,
    "margin_text": (*CHANGES, "test_run_calibration.py"),
    "live_margin": ("test_run_calibration.py",),
    "held_model": (*WATCHED, "test_strangers.py", "test_margin_period.py"),
    "filtered_robot": (
        "test_filtered_robot.py",
        "test_remembered.py",
        "test_margin_period.py",
        "../internals/safety/test_filtered_robot.py",
        "../internals/safety/test_filtered_robot_standing.py",
        *WATCHED,
        "test_pending_actions.py",
        "test_standstill.py",
        *WAY_OUT,
        "test_throttle_backup.py",
        "../operations/test_stop_orders.py",
        "../robots/test_robot_scene.py",
        "../sensing/test_nothing_seen.py",
    ),
    "surroundings_ahead": (
        "test_pending_actions.py",
        "../sensing/test_nothing_seen.py",
    ),
    "way_out": WAY_OUT,
    "standstill": ("test_standstill.py",),
    "orders": ("../operations/test_stop_orders.py",),
    "node": (
        "test_filtered_robot.py",
        "test_remembered.py",
        "test_margin_period.py",
        *WATCHED,
        "../operations/test_stop_orders.py",
        "../services/test_shipped.py",
        *STRANGERS,
        "../sensing/test_nothing_seen.py",
    ),
    "on_its_way": ("test_on_its_way.py", "test_remembered.py", "test_pending_actions.py"),
    "trail": ("test_remembered.py", "test_found_delay.py", "test_pending_actions.py"),
    "found_delay": ("test_found_delay.py",),
    "pending_actions": PENDING,
    "closed_loop": ("test_throttle_backup.py", *ROLLOUT),
    "rollout_barrier": ROLLOUT,
    "check_backup": CHECK,
    "check_barriers": CHECK,
    "filter_check": CHECK,
    "check_influence": CHECK,
    "check_probes": CHECK,
    "check_report": ("test_check_filter.py",),
    "theory_bound": ("test_theory_bound.py",),
    "robots.car.theory_gradient": ("test_theory_bound.py",),
    "theory_layer": ("test_theory_measure.py",),
    "theory_lipschitz": ("test_theory_bound.py",),
    "theory_measure": ("test_theory_measure.py", "test_theory_bound.py"),
    "theory_recorded": ("test_theory_measure.py",),
    "records.units": ("../records/test_units_of_columns.py", "../records/test_column_map.py"),
    "bus.wire.codec": ("../bus/test_codec.py",),
    "bus.wire.topics": ("../bus/test_topics.py", "../bus_security/test_access.py", "../bus/test_bundle.py"),
    "bus.wire.stamp": STAMPS,
    "bus.wire.version": REQUESTS,
    "bus.wire.requests": REQUESTS,
    "bus.security.certificates": (
        *CERTIFICATES,
        "../hostile/test_keys.py::test_a_card_that_is_none_is_refused",
        "../hostile/test_keys.py::test_a_card_where_nothing_is_open_is_refused",
    ),
    "bus.security.access": (
        "../bus_security/test_access.py",
        "../bus_security/test_conditions_by_hand.py",
        "../bus/test_bundle.py::test_only_who_may_speak_for_every_robot_may_send_bundles_and_no_robot_may_read_one",
        "../bus/test_bundle.py::test_who_links_a_router_for_some_robots_may_bring_no_bundle",
    ),
    "bus.security.authority": CERTIFICATES,
    "bus.security.doorkeeper": DOORKEEPER,
    "diagnosis.search.acceptance": ("../diagnosis/test_acceptance_by_hand.py",),
    "diagnosis.search.judgement": (
        "../diagnosis/test_judgement_by_hand.py",
        "../diagnosis/test_smallest_model.py::test_lateness_that_the_servo_or_another_lateness_may_feign",
    ),
    "diagnosis.search.stages": ("../diagnosis/test_stages_by_hand.py",),
    "diagnosis.search.second_opinion": (
        "../diagnosis/test_second_opinion.py",
        "-../diagnosis/test_second_opinion.py::test_what_feedback_feigns_is_not_added",
    ),
    "diagnosis.fit.heldout": (
        "../diagnosis/test_acceptance_by_hand.py",
        "../diagnosis/test_statistics_by_hand.py::test_the_error_over_folds_is_that_of_a_mean",
    ),
    "diagnosis.fit.readiness": ("../diagnosis/test_readiness_by_hand.py",),
    "diagnosis.fit.evidence": ("../diagnosis/test_evidence_by_hand.py",),
    "diagnosis.search.closest": (
        "../diagnosis/test_closest_by_hand.py",
        "../diagnosis/test_sizes_not_told.py::test_an_effect_within_one_deviation_of_nothing_is_doubtful",
    ),
    "diagnosis.unexplained": ("../diagnosis/test_coverage.py",),
    "diagnosis.coverage": ("../diagnosis/test_coverage.py",),
    "compare.rollout_error": ("../diagnosis/test_rollout_error.py",),
    "compare.bins": ("../diagnosis/test_bins_by_hand.py", EDGES),
    "compare.windows": ("../diagnosis/test_windows_by_hand.py",),
    "compare.where": (
        "../diagnosis/test_where_by_hand.py",
        "../diagnosis/test_where.py::test_explained_is_the_adjusted_share_of_variance",
        "../diagnosis/test_where.py::test_one_glitch_does_not_own_the_squared_error",
    ),
    "replay.comparison": ("../replay/test_comparison_by_hand.py", "../replay/test_judging.py"),
    "replay.gaps": ("../replay/test_gaps_by_hand.py",),
    "safedpa_lab.experiments.statistics": (
        "../experiments/test_intervals_by_hand.py",
        "../experiments/test_counts_by_hand.py",
    ),
    "safedpa_lab.experiments.paired": ("../experiments/test_paired.py",),
}
"""Which tests judge which module, the quickest first; named as seen from ``tests/safety``, with "-" those left out.

Modules of ``safedpa.safety``; by a name with dots others of ``safedpa``, and with ``safedpa_lab`` before it those of
the laboratory. What is written by a program (``robots.car.written_barriers``) is judged by the test that it is what
that program writes.
"""
