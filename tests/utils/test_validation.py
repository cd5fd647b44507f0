"""What messages show of a wrong value."""
import numpy as np
import pytest

from photutils_mgauss.utils.validation import as_choice, as_real, shown


def test_a_value_is_shown_in_one_short_line():
    text = shown(np.arange(1000.0).reshape(10, 100))
    assert '\n' not in text
    assert len(text) <= 80


@pytest.mark.parametrize(('value', 'text'), [
    (np.str_('blob'), "'blob'"), (np.int64(7), '7'), (None, 'None'),
    ([1, 'a'], "[1, 'a']")])
def test_a_value_is_shown_as_it_was_typed(value, text):
    assert shown(value) == text


def test_errors_show_values_like_that():
    with pytest.raises(ValueError, match=r"one of 'a', got 'blob'$"):
        as_choice(np.str_('blob'), 'name', ('a',))
    with pytest.raises(TypeError, match=r'number, got [^\n]+$'):
        as_real([[0.1] * 30] * 30, 'radius')
