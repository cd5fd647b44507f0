"""A page of HTML that needs no other file: figures, tables, records."""
import json
from base64 import b64encode
from dataclasses import dataclass, field
from html import escape
from io import BytesIO

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1b2733; margin: 0 auto;
       max-width: 1200px; padding: 0 16px 48px; background: #fff; }
h1 { font-size: 1.6em; margin: 24px 0 0; }
h2 { font-size: 1.25em; margin: 40px 0 8px; padding-top: 8px;
     border-top: 2px solid #44617b; overflow-wrap: anywhere; }
p { margin: 8px 0; max-width: 75ch; }
nav ul { padding-left: 20px; margin: 8px 0; }
nav a { color: #00558a; overflow-wrap: anywhere; }
.figures { display: grid; gap: 16px;
           grid-template-columns: repeat(auto-fit, minmax(min(100%, 340px),
                                                          1fr)); }
figure { margin: 0; padding: 10px 12px; border-radius: 10px; color: #1b2733;
         background: #fff; border: 1px solid #d5dde4; }
figure img { width: 100%; max-width: 560px; height: auto; display: block; }
figcaption { font-size: 0.9em; color: #44617b; }
.wide { overflow-x: auto; margin: 12px 0; }
table { border-collapse: collapse; font-size: 0.9em; }
th, td { padding: 3px 12px 3px 0; text-align: right; white-space: nowrap;
         border-bottom: 1px solid #d5dde4; }
th:first-child, td:first-child { text-align: left; white-space: normal; }
details { margin: 12px 0; font-size: 0.9em; }
summary { cursor: pointer; color: #00558a; }
pre { overflow-x: auto; background: #f2f5f8; padding: 8px; }
.verdict { font-weight: 600; padding-left: 10px; border-left: 6px solid; }
.good { border-color: #009e73; }
.look { border-color: #d55e00; }
@media (prefers-color-scheme: dark) {
  body { color: #dce4ea; background: #15191d; }
  figure { background: #e3e9ee; border-color: #e3e9ee; }
  nav a, summary { color: #7cc0ee; }
  pre { background: #22282e; }
  th, td { border-color: #38424b; }
}
"""


@dataclass(frozen=True)
class Panel:
    """A figure: a function that draws on Axes, and its caption."""

    draw: object
    caption: str


@dataclass(frozen=True)
class Verdict:
    """Whether a result is good, in one sentence with its numbers."""

    good: bool
    words: str


@dataclass(frozen=True)
class Section:
    """What a page says of one result."""

    title: str
    verdict: Verdict | None = None
    text: str = ''
    facts: dict = field(default_factory=dict)
    panels: tuple = ()
    rows: list = field(default_factory=list)
    record: dict = field(default_factory=dict)


def html_page(title, sections, record):
    """
    Return the page, with its figures inside.

    Parameters
    ----------
    title : str
        Of the page.
    sections : sequence of Section
        What it shows.
    record : dict
        How it was made.

    Returns
    -------
    str
    """
    links = ''.join(f'<li><a href="#part{i}">{escape(section.title)}</a>'
                    f'{_verdict("span", section.verdict)}</li>'
                    for i, section in enumerate(sections))
    parts = ''.join(_part(i, section) for i, section in enumerate(sections))
    return (f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            f'<meta name="viewport" content="width=device-width, '
            f'initial-scale=1"><title>{escape(title)}</title>'
            f'<style>{_STYLE}</style></head>\n<body><h1>{escape(title)}</h1>'
            f'<p>Made {escape(record["date"])} by photutils_mgauss '
            f'{escape(record["version"])}.</p>'
            f'<nav aria-label="Results"><ul>{links}</ul></nav>\n{parts}'
            f'{_details("How this page was made", record)}</body></html>\n')


def _verdict(tag, verdict):
    """Return a verdict as an element of the page."""
    if verdict is None:
        return ''
    kind, word = (('good', 'Good') if verdict.good else
                  ('look', 'Look at this'))
    gap = '' if tag == 'p' else ' '
    return (f'{gap}<{tag} class="verdict {kind}">{word}: '
            f'{escape(verdict.words)}</{tag}>')


def _part(number, section):
    figures = ''.join(_figure(section.title, panel)
                      for panel in section.panels)
    return (f'<section id="part{number}"><h2>{escape(section.title)}</h2>'
            + _verdict('p', section.verdict)
            + (f'<p>{escape(section.text)}</p>' if section.text else '')
            + _facts(section.facts)
            + (f'<div class="figures">{figures}</div>' if figures else '')
            + _rows(section.rows)
            + (_details('How it was made', section.record)
               if section.record else '') + '</section>\n')


def _facts(facts):
    if not facts:
        return ''
    lines = ''.join(f'<tr><td>{escape(name)}</td><td>{escape(str(value))}'
                    '</td></tr>' for name, value in facts.items())
    return f'<div class="wide"><table>{lines}</table></div>'


def _rows(rows):
    """Return a table of a list of dicts with the same keys."""
    if not rows:
        return ''
    head = ''.join(f'<th scope="col">{escape(name)}</th>' for name in rows[0])
    body = ''.join('<tr>' + ''.join(f'<td>{escape(str(value))}</td>'
                                    for value in row.values()) + '</tr>'
                   for row in rows)
    return (f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
            f'<tbody>{body}</tbody></table></div>')


def _figure(title, panel):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    figure = Figure(figsize=(5.2, 4.2), dpi=120, layout='constrained')
    panel.draw(figure.subplots())
    # The card that the page puts figures on, light on dark pages too, is
    # their background.
    for patch in (figure.patch, *(one.patch for one in figure.axes)):
        patch.set_alpha(0)
    # How wide the numbers beside colour bars are is known once they are drawn:
    # only then are they laid out, once.
    layout = figure.get_layout_engine()
    figure.set_layout_engine('none')
    figure.draw_without_rendering()
    figure.set_layout_engine(layout)
    picture = BytesIO()
    FigureCanvasAgg(figure).print_png(picture)
    data = b64encode(picture.getvalue()).decode()
    return (f'<figure><img alt="{escape(title)}: {escape(panel.caption)}" '
            f'src="data:image/png;base64,{data}"><figcaption>'
            f'{escape(panel.caption)}</figcaption></figure>')


def _details(words, record):
    text = escape(json.dumps(_short(record), indent=1))
    return (f'<details><summary>{escape(words)}</summary><pre>{text}</pre>'
            '</details>')


def _short(record):
    """Return a record without options that were not given and long lists."""
    used = {name: value for name, value in record.get('options', {}).items()
            if value not in (None, False)}
    rest = {name: value for name, value in record.items() if name != 'stars'}
    return {**rest, 'options': used}
