"""
The picture of the house, drawn from ``layers.csv`` and from the imports.

Rooms stand on their floors; a new room needs its columns here. An arrow is an
import. Those that follow from others are left out, and so are those that go
up, which ``plot*`` methods and ``from_*`` constructors may do.
"""
import ast
import csv
import itertools
import textwrap
from pathlib import Path

from make_gallery import write

import photutils_mgauss

PACKAGE = Path(photutils_mgauss.__file__).parent
WIDTH, COLUMN, GAP, STAIRS, TOP = 996, 140, 14, 40, 20
HEIGHTS = {False: 72, True: 124}  # of floors without and with narrow rooms
# First column and number of columns of each room.
COLUMNS = {
    'cli': (0, 7), 'plotting': (0, 1), 'pixel_motions': (5, 2),
    'simulation': (1, 1),
    'fitting': (2, 1), 'field': (3, 1), 'crowded': (4, 1),
    'photometry': (5, 1), 'motions': (6, 1), 'psf': (0, 6),
    'kernels': (0, 3), 'files': (3, 3), 'sky': (6, 1), 'utils': (0, 7)}
COLOURS = {'image': '#dbe9f6', 'sky': '#e2efda', '': '#f1efe9'}
STYLE = """\
text { font-family: Helvetica, Arial, sans-serif; fill: #1b2733;
       text-anchor: middle; }
.name { font-size: 16px; font-weight: bold; }
.what { font-size: 12px; }
.note { font-size: 13px; font-style: italic; }
.over { paint-order: stroke; stroke: #ffffff; stroke-width: 6; }
rect { stroke: #44617b; stroke-width: 1.5; }
path { fill: none; stroke: #44617b; stroke-width: 1.8; }
.waist { stroke: #c98a1b; stroke-width: 2; stroke-dasharray: 7 5; }"""
TIP = ('<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" '
       'markerWidth="7" markerHeight="7" orient="auto">'
       '<path d="M0 0 L10 5 L0 10 z" style="fill: #44617b"/></marker></defs>')


def read_rooms():
    """Return the rows of the table of rooms, by the name of the room."""
    table = Path(__file__).with_name('layers.csv')
    with table.open(newline='', encoding='utf-8') as file:
        return {row['Room']: row for row in csv.DictReader(file)}


def imported_rooms(room):
    """Return the rooms that the modules of a room import."""
    found = set()
    for path in (PACKAGE / room).glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.ImportFrom) and node.module:
                top, _, rest = node.module.partition('.')
                if top == 'photutils_mgauss':
                    found |= ({rest.partition('.')[0]} if rest else {
                        photutils_mgauss._OWNERS.get(alias.name, alias.name)
                        for alias in node.names})
    return found


def shown_imports(rooms):
    """Return pairs of rooms, upper and lower, that an arrow connects."""
    floor = {room: int(row['Floor']) for room, row in rooms.items()}
    direct = {room: {other for other in imported_rooms(room)
                     if floor.get(other, 99) < floor[room]} for room in rooms}
    return [(room, other) for room in rooms for other in direct[room]
            if not any(other in below(direct, middle)
                       for middle in direct[room])]


def below(direct, room):
    """Return all rooms under a room that it needs, directly or not."""
    return direct[room].union(*(below(direct, other)
                                for other in direct[room]))


def heights(rooms):
    """Return the height [px] of each floor, the lowest first."""
    narrow = {int(row['Floor']) for room, row in rooms.items()
              if COLUMNS[room][1] == 1}
    floors = 1 + max(int(row['Floor']) for row in rooms.values())
    return [HEIGHTS[floor in narrow] for floor in range(floors)]


def place(room, rooms):
    """Return left, top, right and bottom [px] of a room."""
    first, n = COLUMNS[room]
    floor, left = int(rooms[room]['Floor']), GAP + first * COLUMN
    above = heights(rooms)[floor:]
    bottom = TOP + sum(above) + STAIRS * (len(above) - 1)
    return left, bottom - above[0], left + n * COLUMN - GAP, bottom


def draw_room(room, rooms):
    """Yield the box of a room with what lives there."""
    left, top, right, bottom = place(room, rooms)
    row, x = rooms[room], (left + right) / 2
    n = len(list((PACKAGE / room).glob('*.py'))) - 1
    yield (f'<rect x="{left}" y="{top}" width="{right - left}" '
           f'height="{bottom - top}" rx="7" '
           f'style="fill: {COLOURS[row["Half"]]}"/>')
    yield words('name', x, top + 21, room)
    for k, line in enumerate(textwrap.wrap(row['What lives there'],
                                           (right - left) // 7)):
        yield words('what', x, top + 40 + 14 * k, line)
    yield words('note', x, bottom - 8, f'{n} modules')


def words(kind, x, y, text):
    """Return a line of text around x."""
    return f'<text class="{kind}" x="{x}" y="{y}">{text}</text>'


def draw_import(upper, lower, rooms):
    """Return an arrow from a room down to one that it imports."""
    left, _, right, start = place(upper, rooms)
    low, end, high, _ = place(lower, rooms)
    x = (max(left, low) + min(right, high)) / 2
    way = f'M{x} {start} L{x} {end - 3}'
    if low > right:  # the lower room stands to the right of the upper one
        turn = start + STAIRS / 2
        way = (f'M{right - 30} {start} L{right - 30} {turn} '
               f'L{low + 40} {turn} L{low + 40} {end - 3}')
    return f'<path d="{way}" marker-end="url(#tip)"/>'


def draw_waist(rooms):
    """Yield the line between the halves and what crosses it."""
    left, top, *_ = place('motions', rooms)
    x, bottom = left - GAP / 2, place('sky', rooms)[3]
    yield (f'<path class="waist" d="M{x} {top - STAIRS} '
           f'L{x} {bottom + STAIRS / 2}"/>')
    yield words('note over', x, top - STAIRS - 6,
                'the waist: one table for each exposure')


def picture():
    """Return the house as SVG."""
    rooms = read_rooms()
    height = place('utils', rooms)[3] + TOP
    body = itertools.chain(
        (draw_import(*pair, rooms) for pair in sorted(shown_imports(rooms))),
        draw_waist(rooms),
        *(draw_room(room, rooms) for room in rooms))
    head = (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} '
            f'{height}" role="img" aria-label="Rooms of the package">')
    paper = (f'<rect width="{WIDTH}" height="{height}" '
             f'style="fill: #ffffff; stroke: none"/>')
    return '\n'.join([head, f'<style>\n{STYLE}\n</style>', TIP, paper,
                      *body, '</svg>\n'])


def build(app):
    """Write the picture where the page on the architecture finds it."""
    path = Path(app.srcdir) / 'generated' / 'house.svg'
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, picture())


def setup(app):
    """Tell Sphinx."""
    app.connect('builder-inited', build)
    return {'parallel_read_safe': True}
