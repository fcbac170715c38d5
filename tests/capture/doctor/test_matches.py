# SPDX-License-Identifier: Apache-2.0
"""Points found twice, and which cameras they agree with."""

from __future__ import annotations

import numpy as np

from raytran.capture.doctor.matches import match_frames, triangulate


def of_all(intrinsics, poses):
    return np.broadcast_to(intrinsics, (len(poses), 3, 3))


def test_true_cameras_explain_exact_matches_and_give_their_depths(walk):
    poses, intrinsics, matches, depth = walk
    agrees, found = triangulate(matches, poses, of_all(intrinsics, poses))
    assert agrees.all()
    np.testing.assert_allclose(found, depth, rtol=1e-6)
    rays = np.c_[matches.pixel[:, 0], np.ones(len(matches))] @ np.linalg.inv(intrinsics).T
    first = poses[matches.frame[:, 0]]
    points = np.einsum("nij,nj->ni", first[:, :3, :3], rays * found[:, None]) + first[:, :3, 3]
    second = poses[matches.frame[:, 1]]
    seen = np.einsum("nji,nj->ni", second[:, :3, :3], points - second[:, :3, 3]) @ intrinsics.T
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], matches.pixel[:, 1], atol=1e-6)


def test_frames_may_have_intrinsics_of_their_own(walk):
    poses, intrinsics, matches, depth = walk
    zooms = 1 + 0.2 * np.sin(np.arange(len(poses)))
    own = np.stack([np.diag([zoom, zoom, 1.0]) @ intrinsics for zoom in zooms])
    pixel = matches.pixel * zooms[matches.frame][..., None]
    agrees, found = triangulate(type(matches)(matches.frame, pixel, 0.5), poses, own)
    assert agrees.all()
    np.testing.assert_allclose(found, depth, rtol=1e-6)
    shared = of_all(np.median(own, axis=0), poses)
    assert triangulate(type(matches)(matches.frame, pixel, 0.5), poses, shared)[0].mean() < 0.5


def test_a_match_off_its_epipolar_line_does_not_agree(walk):
    poses, intrinsics, matches, _ = walk
    first, second = poses[matches.frame[:, 0]], poses[matches.frame[:, 1]]
    turn = np.einsum("nji,njk->nik", second[:, :3, :3], first[:, :3, :3])
    shift = np.einsum("nji,nj->ni", second[:, :3, :3], first[:, :3, 3] - second[:, :3, 3])
    rays = np.c_[matches.pixel[:, 0], np.ones(len(matches))] @ np.linalg.inv(intrinsics).T
    line = np.cross(shift, np.einsum("nij,nj->ni", turn, rays)) @ np.linalg.inv(intrinsics)
    across = line[:, :2] / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    for pixels, expected in ((0.3, True), (4.0, False)):
        moved = matches.pixel.copy()
        moved[:, 1] += pixels * across
        agrees, _ = triangulate(type(matches)(matches.frame, moved, 0.5), poses, of_all(intrinsics, poses))
        assert agrees.mean() > 0.95 if expected else agrees.mean() < 0.05


def test_rays_that_meet_behind_the_cameras_do_not_agree(walk):
    poses, intrinsics, matches, _ = walk
    backwards = poses.copy()
    backwards[:, :3, 3] *= -1  # The epipolar lines stay, the points lie behind.
    assert not triangulate(matches, backwards, of_all(intrinsics, poses))[0].any()


def test_points_of_real_images_agree_with_their_cameras(raw, matches):
    assert len(matches) > 200
    agrees, depth = triangulate(matches, raw.stored, raw.intrinsics)
    assert agrees.mean() > 0.8
    assert 0.8 < np.median(depth[agrees]) < 4.0
    assert (matches.frame[:, 0] != matches.frame[:, 1]).all()
    height, width = raw.scan.image_size
    assert (matches.pixel > 0).all()
    assert (matches.pixel < (width, height)).all()


def test_blank_and_single_frames_give_no_matches():
    blank = np.full((60, 80), 0.5, dtype=np.float32)
    for count in (0, 1, 2, 7):
        matches = match_frames(lambda frame, width: (blank, 1.0), count)
        assert len(matches) == 0
        assert matches.pixel.shape == (0, 2, 2)


def test_frames_that_hardly_move_are_compared_with_later_ones():
    rng = np.random.default_rng(0)
    wall = np.kron(rng.random((40, 80)), np.ones((6, 6))).astype(np.float32)

    def read(frame, width):
        return np.ascontiguousarray(wall[:180, frame : frame + 240]), 1.0

    matches = match_frames(read, 40)
    gap = matches.frame[:, 1] - matches.frame[:, 0]
    assert np.abs(gap).min() >= 8
    np.testing.assert_allclose(np.median(matches.pixel[:, 0, 0] - matches.pixel[:, 1, 0] - gap), 0, atol=0.5)


def test_no_point_is_sought_outside_of_the_pictures():
    rng = np.random.default_rng(0)
    wall = np.kron(rng.random((40, 80)), np.ones((6, 6))).astype(np.float32)

    def read(frame, width):
        grey = np.full((180, 240), 0.5, dtype=np.float32)
        grey[:, 60:180] = wall[:180, frame : frame + 120]
        return grey, 0.5

    picture = np.tile([120.0, 0.0, 360.0, 360.0], (40, 1))
    matches = match_frames(read, 40, picture=picture)
    assert len(matches) > 50
    # Twice the pixels of the grey images, and sixteen of these from the border.
    assert matches.pixel[..., 0].min() >= 120 + 32
    assert matches.pixel[..., 0].max() < 360 - 32
