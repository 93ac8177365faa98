import numpy as np

from msg_analysis.inference.statistics import holm


def test_by_hand():
    """0.01 x 4, 0.02 x 3, 0.03 x 2, 0.04 x 1, each at least the one before."""
    np.testing.assert_allclose(holm(np.array([0.04, 0.01, 0.03, 0.02])), [0.06, 0.04, 0.06, 0.06])


def test_never_above_one_nor_below_the_plain_values():
    p = np.array([0.0, 0.5, 0.9, 0.3])
    adjusted = holm(p)
    np.testing.assert_allclose(adjusted, [0.0, 1.0, 1.0, 0.9])
    assert (adjusted >= p).all()


def test_none_and_one():
    assert holm(np.array([])).shape == (0,)
    assert holm(np.array([0.2])).tolist() == [0.2]
