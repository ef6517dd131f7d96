"""The questions that the measured rows answer: one page each, by the command that measured the row."""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Question:
    """One page of results.

    Attributes:
        slug: Name of the page, ``docs/results/<slug>.md``.
        title: The question.
        answers: What it is about, in a sentence.
        commands: Benchmarks and campaigns, by their names, and other commands, by their beginning, that measure its rows.
        picture: What stands first on the page, relative to it; empty for nothing.
    """

    slug: str
    title: str
    answers: str
    commands: tuple[str, ...]
    picture: str = ""


QUESTIONS = (
    Question(
        "gradients",
        "Are the gradients right, and what do they cost?",
        "The adjoint against back-propagation and finite differences, its memory and time, and the search without gradients.",
        (
            "adjoint_gradient",
            "adjoint_memory",
            "gradient_pass",
            "baked_scene",
            "floors",
            "seeds_together",
            "gpu",
            "closed_loop_cosine",
            "mesh_render",
            "black_box",
            "ros2_black_box",
            "campaign_scaling",
        ),
    ),
    Question(
        "learned_places",
        "How good are learned places and objects?",
        "Held-out photographs, poses found from them, objects learned from meshes, and the speed of training.",
        (
            "fox",
            "learning_rates",
            "hydrant",
            "objects",
            "object_pictures",
            "phone_to_car",
            "structure_from_motion",
            "few_photographs",
            "sample_intervals",
            "exposure",
            "splats",
            "training_step",
            "victim_training",
            "scene_stage",
            "hash_encoding",
        ),
    ),
    Question(
        "room",
        "Does an attack found in the learned room work live?",
        "The room with green screen and monitor, driven live on the simulated lab.",
        ("make experiment", "newcomer", "counterfactual_live"),
        picture="room_above.webp",
    ),
    Question(
        "audits",
        "Does an audit of an own policy tell the truth?",
        "From an own policy and photographs to the verdict, what the place itself says of it, and audits whose truth is known.",
        ("own_place", "foreign_audit", "audit_truth"),
    ),
    Question(
        "statistics",
        "Are the intervals and tests right?",
        "Coverage of intervals and error rates of tests on simulated drives whose true effect is known, and what verifying finds.",
        ("coverage", "anytime", "planted_changes", "verify_time"),
    ),
    Question(
        "hardened",
        "Does a victim trained with textures withstand random ones?",
        "The best random search of every published set, and victims that were judged by the worst of N textures. A victim is called hardened only "
        "where the worst texture of a family that did not train it moves it by less than the margin, judged before any gradient search.",
        ("hardening",),
    ),
    Question(
        "retraining",
        "Does retraining on attacks help?",
        "Policies trained again on the attacks that were found against them.",
        ("advnerf experiment run launch/junction",),
    ),
    Question(
        "stopping",
        "Does the car stop when it must?",
        "Time and distance to the brake after faults, false stops, strangers, and half an hour of driving.",
        (
            "fault_stops",
            "fault_campaign",
            "stalls",
            "pose_jumps",
            "requests",
            "strangers",
            "ros2_strangers",
            "thirty_minutes",
            "page_faults",
            "page_strangers",
            "stops",
        ),
    ),
    Question(
        "live_stack",
        "Is the live stack fast and accurate?",
        "Latency, launch, memory, two computers, calibration, and a policy learned from recordings.",
        (
            "one_hop",
            "log_round_trip",
            "frame_age",
            "launch_times",
            "car_nodes",
            "two_hosts",
            "ros2_latency",
            "lockstep_replay",
            "calibrations",
            "policy_from_bags",
            "foreign_worlds",
            "page_latency",
        ),
    ),
    Question(
        "other_worlds",
        "What is left of an attack in another world?",
        "Attacks on a panel that the world's own renderer shows, driven by the world's own car, and how well that was predicted.",
        ("gap", "predictions", "printed", "learned_roads", "unseen_roads", "make world"),
        picture="gap_duckietown_robust_above.webp",
    ),
    Question(
        "paper_table",
        "What does the paper's table say on one build?",
        "The registered sets of the paper's own experiments, and what its assumptions about the lab are worth.",
        ("paper_table", "victim_panel"),
        picture="paper_junction_above.webp",
    ),
    Question(
        "correlation",
        "Does the learned scene tell what will happen?",
        "Each registered search: the effect of its attack in the learned scene against the effect deployed.",
        ("transfer_correlation",),
        picture="transfer_correlation.png",
    ),
    Question(
        "green",
        "Are tests and demo green on a slow or busy machine?",
        "Repeated runs, beside endless loops and on one core, and tests of whole kinds of faults.",
        ("repeat_tests", "demo_against", "tests_cost"),
    ),
    Question(
        "size",
        "How much is there to read, to learn and to clone?",
        "Counts of the code, of the pages, of the command line and of what git tracks.",
        ("house",),
    ),
    Question(
        "nothing_is_lost",
        "Is anything lost when something breaks?",
        "Damaged and cut files, killed processes, and hostile input.",
        ("bag_damage", "bag_kill", "attack_kill", "audit_kills", "scene_kill", "fuzz", "world_faults"),
    ),
)

OTHER = Question("other", "Other measurements", "Rows of commands that no question names.", ())


def question_of(command: str) -> Question:
    """The question that a row measured by ``command`` answers; `OTHER` if none names it."""
    benchmark = re.search(r"\b(?:benchmarks\.|make campaign ONLY=)(\w+)", command)
    for question in QUESTIONS:
        if any(benchmark[1] == name if benchmark else command.startswith(name) for name in question.commands):
            return question
    return OTHER
