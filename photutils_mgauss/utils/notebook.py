"""How results show themselves in notebooks."""
import base64
import io
from html import escape

__all__ = ['with_picture', 'with_table']


def with_picture(text, draw):
    """
    Return HTML of a text and of a small figure below it.

    Parameters
    ----------
    text : str
        Plain text, such as the ``repr`` of the object.
    draw : callable
        Draws on the Axes it is given.

    Returns
    -------
    str
        The text alone where matplotlib is not installed.
    """
    words = f'<p><code>{escape(text)}</code></p>'
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return words
    figure = Figure(figsize=(3.6, 2.8), layout='constrained')
    draw(figure.add_subplot())
    file = io.BytesIO()
    figure.savefig(file, format='png', dpi=90)
    code = base64.b64encode(file.getvalue()).decode()
    return f'{words}<img alt="" src="data:image/png;base64,{code}">'


def with_table(text, table):
    """Return HTML of a text and of a table below it, as astropy shows it."""
    return f'<p><code>{escape(text)}</code></p>{table._repr_html_()}'
