"""Selects the pairs of photographs to match: all pairs of few images, or else neighbours in time and similar images.

Looking alike is measured by VLAD (Jegou et al. 2010) over the set's own local features: a vocabulary is learned from a sample of
them, so that none has to be fetched.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Descriptors = NDArray[np.uint8]

_FEATURE_SIZE = 128  # of SIFT
_WORDS = 32
_VOCABULARY_SAMPLE = 20_000
_ITERATIONS = 12


def every_pair(count: int) -> list[tuple[int, int]]:
    """All pairs of ``count`` images."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def chosen_pairs(
    descriptors: Sequence[Descriptors],
    sequences: Sequence[Sequence[int]],
    overlap: int,
    look_alikes: int,
    seed: int,
) -> list[tuple[int, int]]:
    """Neighbours in time, at growing distances too, and for every image the most similar ones.

    Args:
        descriptors: Local features of each image ``[n_i, 128]`` uint8.
        sequences: Images in the order of each video.
        overlap: Number of an image's followers in its video.
        look_alikes: Number of similar images, out of all.
    """
    pairs: set[tuple[int, int]] = set()
    for order in sequences:
        steps = {*range(1, overlap + 1), *(2**power for power in range(2, 20))}
        for step in steps:
            pairs.update((min(a, b), max(a, b)) for a, b in zip(order, order[step:], strict=False))
    similarity = looks(descriptors, seed)
    np.fill_diagonal(similarity, -np.inf)
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, :look_alikes]
    pairs.update((min(a, int(b)), max(a, int(b))) for a, row in enumerate(nearest) for b in row)
    return sorted(pairs)


def looks(descriptors: Sequence[Descriptors], seed: int) -> NDArray[np.float64]:
    """Similarity of images, ``[N, N]`` in -1..1: the cosine between their VLAD vectors."""
    rng = np.random.default_rng(seed)
    stacked = np.concatenate([_rooted(d) for d in descriptors])
    if len(stacked) < _WORDS:
        return np.zeros((len(descriptors), len(descriptors)))
    sample = stacked[rng.choice(len(stacked), min(_VOCABULARY_SAMPLE, len(stacked)), replace=False)]
    words = _vocabulary(sample, rng)
    vectors = np.stack([_vlad(_rooted(d), words) for d in descriptors])
    return np.asarray(vectors @ vectors.T, np.float64)


def _vocabulary(sample: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Cluster centres ``[words, d]`` by Lloyd's iterations from a random start; they need to be typical, not optimal."""
    words = sample[rng.choice(len(sample), _WORDS, replace=False)]
    for _ in range(_ITERATIONS):
        nearest = _nearest(sample, words)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, sample)
        counts = np.bincount(nearest, minlength=_WORDS)
        used = counts > 0
        words = words.copy()
        words[used] = sums[used] / counts[used, None]
    return words


def _vlad(features: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum of what is left of the features beyond their words, normalised within each word and as a whole."""
    total = np.zeros_like(words)
    if len(features):
        nearest = _nearest(features, words)
        np.add.at(total, nearest, features - words[nearest])
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    return np.asarray(total.reshape(-1) / max(float(np.linalg.norm(total)), 1e-9))


def _nearest(features: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.intp]:
    return np.argmax(features @ words.T - 0.5 * (words**2).sum(axis=1), axis=1)


def _rooted(descriptors: Descriptors) -> NDArray[np.float32]:
    """Features of unit length."""
    values = np.asarray(descriptors, np.float32).reshape(-1, _FEATURE_SIZE)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9), np.float32)
