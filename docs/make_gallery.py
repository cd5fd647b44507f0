"""
The gallery: a page and a thumbnail for every script in ``docs/gallery``.

A script begins with a docstring, whose first line, without its full stop, is
the title, and leaves its figure in the variable ``figure``, as wide as a
column of a journal or as two. It runs when the pages are built, and again
only when it has changed.
"""
import ast
import runpy
import textwrap
from pathlib import Path

DPI = 200
THUMBNAIL = 320  # pixels wide
# Letters that can be read in a column of 88 mm, and lines to go with them.
STYLE = {'font.size': 7.5, 'axes.titlesize': 8, 'legend.fontsize': 6.5,
         'lines.linewidth': 1, 'lines.markersize': 4, 'axes.linewidth': 0.6}

PAGE = """\
{title}
{line}

.. image:: {name}.png
   :alt: {title}

{text}

.. literalinclude:: {script}
   :language: python
   :lines: {first}-
"""
ENTRY = """\
   .. figure:: {name}_small.png
      :target: {name}.html
      :alt: {title}

      :doc:`{title} <{name}>`

"""
INDEX = """\
Gallery
=======

This page shows all figures of the gallery. Click a figure to see the script
that makes it from simulated data.

.. container:: gallery

{entries}
Several scripts import their simulations from ``docs/gallery_scenes.py``:

.. literalinclude:: ../../gallery_scenes.py
   :language: python

.. toctree::
   :hidden:

{names}
"""


def build(app):
    """Draw what has changed and write the pages."""
    folder = Path(app.srcdir) / 'generated' / 'gallery'
    folder.mkdir(parents=True, exist_ok=True)
    scripts = sorted((Path(app.srcdir) / 'gallery').glob('*.py'))
    titles = {script.stem: _page(script, folder) for script in scripts}
    write(folder / 'index.rst', INDEX.format(
        entries=''.join(ENTRY.format(name=name, title=title)
                        for name, title in titles.items()),
        names=textwrap.indent('\n'.join(titles), '   ')))


def _page(script, folder):
    """Write the page of a script and return its title."""
    picture = folder / f'{script.stem}.png'
    if (not picture.exists()
            or picture.stat().st_mtime < script.stat().st_mtime):
        _draw(script, picture)
    code = script.read_text(encoding='utf-8')
    tree = ast.parse(code)
    title, _, text = ast.get_docstring(tree).partition('.\n')
    write(folder / f'{script.stem}.rst', PAGE.format(
        title=title, line='=' * len(title), name=script.stem,
        text=text.strip(), script=f'../../gallery/{script.name}',
        first=tree.body[0].end_lineno + 1))
    return title


def _draw(script, picture):
    """Run a script and save its figure, large and small."""
    import matplotlib as mpl
    mpl.use('Agg')
    import matplotlib.pyplot as plt
    with plt.rc_context(STYLE):
        figure = runpy.run_path(str(script))['figure']
    _check(figure, script)
    # How wide the numbers beside colour bars are is known once they are drawn.
    figure.draw_without_rendering()
    figure.savefig(picture, dpi=DPI)
    width = figure.get_size_inches()[0]
    figure.savefig(picture.with_name(f'{script.stem}_small.png'),
                   dpi=THUMBNAIL / width)
    plt.close('all')


def _check(figure, script):
    """Raise ValueError if an axis with numbers says not what they are."""
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            if len(axis.get_ticklocs()) and not axis.get_label_text() and any(
                    tick.get_text() for tick in axis.get_ticklabels()):
                msg = f'{script.name}: an axis without a label'
                raise ValueError(msg)


def write(path, text):
    """Write a file unless it says the same already."""
    if not path.exists() or path.read_text(encoding='utf-8') != text:
        path.write_text(text, encoding='utf-8')


def setup(app):
    """Tell Sphinx."""
    app.connect('builder-inited', build)
    return {'parallel_read_safe': True}
