import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from compgs.numerics.rotations import nearest_rotation, quaternion_from_rotation, rotation_from_quaternion

PART = st.floats(-1, 1)
QUATERNION = (
    st.tuples(PART, PART, PART, PART).map(np.array).filter(lambda q: np.abs(q).max() > 1e-6)
)  # of any length


@given(QUATERNION)
def test_rotations_agree_with_scipy(quaternion: np.ndarray) -> None:
    w, x, y, z = quaternion
    expected = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), expected, atol=1e-12)


@given(QUATERNION)
def test_quaternions_survive_the_way_through_a_rotation(quaternion: np.ndarray) -> None:
    found = quaternion_from_rotation(rotation_from_quaternion(quaternion))
    unit = quaternion / np.linalg.norm(quaternion)
    assert found[0] >= 0
    assert abs(found @ unit) > 1 - 1e-12  # q and -q are the same rotation


@given(QUATERNION, st.sampled_from([1e-200, 1e-3, 1e3, 1e200]))
def test_the_length_of_a_quaternion_does_not_matter(quaternion: np.ndarray, length: float) -> None:
    expected = rotation_from_quaternion(quaternion)
    np.testing.assert_allclose(rotation_from_quaternion(quaternion * length), expected, atol=1e-12)


@given(QUATERNION, st.floats(0.01, 100))
def test_nearest_rotation_removes_scale_and_rounding(quaternion: np.ndarray, scale: float) -> None:
    rotation = rotation_from_quaternion(quaternion)
    rounded = (scale * rotation).astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(nearest_rotation(rounded), rotation, atol=1e-6)
    found = nearest_rotation(rounded)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
