"""What the floors count, against the kernels themselves and against sizes worked out by hand."""

import numpy as np
import pytest
import torch
from scipy import sparse

from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig
from advnerf_core.fields.mlp_kernels import TILE
from advnerf_core.parallel import thread_count
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.scene.baked import Voxels
from benchmarks import floors, least_work, machine_floors
from benchmarks.least_work import Work
from benchmarks.machine_floors import Floors

MACHINE = Floors(stream_bps=10e9, flops=100e9, line_s={1 << 20: 1e-9, 1 << 28: 10e-9})


def test_counted_rows_are_those_that_the_encoding_reads() -> None:
    grid = HashGrid(HashGridConfig(levels=6, features=2, log2_entries=8, coarsest=4, finest=200))
    with torch.no_grad():
        grid.table.normal_(generator=torch.Generator().manual_seed(0))
    points = np.random.default_rng(1).random((50, 3), dtype=np.float32)
    with torch.no_grad():
        encoded = grid(torch.from_numpy(points)).numpy()
    for number, level in enumerate(grid.levels):
        rows, place = least_work.level_rows(points, level), points * level[1]
        share = place - np.floor(place)
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        weights = np.where(corners == 1, share[:, None], 1.0 - share[:, None]).prod(axis=-1)
        values = (weights[..., None] * grid.table.detach().numpy()[level[0] + rows]).sum(axis=1)
        np.testing.assert_allclose(values, encoded[:, 2 * number : 2 * number + 2], atol=1e-4)


def test_a_block_at_one_place_reads_its_lines_once() -> None:
    config = HashGridConfig(levels=2, features=2, log2_entries=16, coarsest=16, finest=32)
    together = least_work.encoding(np.full((TILE, 3), 0.51, np.float32), config)
    apart = least_work.encoding(np.random.default_rng(0).random((TILE, 3), dtype=np.float32), config)
    assert together.line_count <= 2 * 8
    assert apart.line_count > 50 * together.line_count
    assert together.streamed == apart.streamed == TILE * 4 * (3 + 4)
    assert together.flops == TILE * 2 * (21 + 32)


def test_baked_rows_are_corners_of_cells_and_of_bricks() -> None:
    brick_of, log_sides = np.full((2, 3, 4), -1, np.int32), np.zeros((2, 3, 4), np.uint8)
    brick_of[1, 2, 3], log_sides[1, 2, 3] = 100, 1  # two parts a side, three corners
    voxels = Voxels(np.zeros((200, 4), np.uint8), brick_of, log_sides, np.zeros(3, np.float32))
    cells = np.full(3, 2.0, np.float32)
    points = np.array([[0.1, 0.6, 0.6], [0.8, 1.1, 1.9]], np.float32)
    rows = least_work.baked_rows(points, voxels, cells)
    corners = [(i, j, k) for i in (0, 1) for j in (1, 2) for k in (1, 2)]
    assert sorted(rows[0]) == sorted(np.ravel_multi_index(corner, (3, 4, 5)) for corner in corners)
    # The point is in part (1, 0, 1) of the brick.
    corners = [(i, j, k) for i in (1, 2) for j in (0, 1) for k in (1, 2)]
    assert sorted(rows[1]) == sorted(100 + np.ravel_multi_index(corner, (3, 3, 3)) for corner in corners)


def test_operations_of_networks_are_those_of_their_sizes() -> None:
    forward, backward = (least_work.two_layers(10, (32, 64, 16), way) for way in (False, True))
    assert forward.flops == 10 * 2 * (32 * 64 + 64 * 16)
    assert backward.flops == 2 * forward.flops
    layers = torch.nn.Sequential(
        torch.nn.Conv2d(3, 8, 5, stride=2), torch.nn.Flatten(), torch.nn.Linear(72, 2)
    )
    work = least_work.network(layers, torch.zeros(1, 3, 9, 9))
    assert work.flops == 2 * 8 * 3 * 3 * 3 * 25 + 2 * 72 * 2
    assert work.streamed == 4 * (8 * 75 + 8 + 144 + 2 + 3 * 81)
    assert 20e6 < least_work.network(PilotNet(0, 0.4), torch.zeros(1, 3, 66, 200)).flops < 100e6


def test_casting_and_composing_move_their_weights() -> None:
    weights = sparse.csr_matrix(np.array([[0.5, 0.0, 0.25], [0.0, 0.0, 1.0]], np.float32))
    cast, composed = least_work.casting(weights, 4096), least_work.composing(weights, 2)
    assert (cast.streamed, cast.flops, cast.lines) == (3 * 8, 6, {4096: 1.0})
    assert (composed.streamed, composed.flops) == (3 * 8 + 2 * 2 * 12, 18)


@pytest.mark.parametrize(
    ("work", "floor_s", "bound"),
    [
        (Work(1e9, {}, 1e9), 0.1, "stream"),
        (Work(0.0, {1 << 20: 1e6, 1 << 29: 1e6}, 0.0), 11e-3, "random lines"),
        (Work(1e6, {}, 1e9), 0.01, "arithmetic"),
    ],
)
def test_the_longer_of_memory_and_arithmetic_is_the_floor(work: Work, floor_s: float, bound: str) -> None:
    assert work.floor_s(MACHINE) == (pytest.approx(floor_s), bound)


def test_the_machine_is_measured_on_all_threads_and_on_one() -> None:
    found = machine_floors.measure((1 << 14, 1 << 16), megabytes=1, repeats=1)
    assert set(found.line_s) == {1 << 14, 1 << 16}
    assert min(found.stream_bps, found.flops, *found.line_s.values()) > 0.0
    assert machine_floors.of_one_thread(lambda: float(thread_count())) == 1.0
    assert machine_floors.latency_s(1 << 16, repeats=1, hops=1000) > 0.0


def test_a_row_has_the_ratio_and_says_what_was_counted() -> None:
    part = floors.Part("tick, policy", lambda: None, Work(1e6, {1 << 20: 5e3}, 1e9))
    line, value, unit, note = floors.part_row(part, 0.02, MACHINE)
    assert (line, value, unit) == ("floor: tick, policy", pytest.approx(2.0), "x the floor")
    assert note == "20 ms; 10 ms; arithmetic; 1 MB in a row, 5 k lines, 1000 MFLOP"
