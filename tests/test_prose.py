"""Pages are written as their contributors are asked to write."""
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / 'docs'
# Nobody writes the list of changes or the results of the reproduction anew.
PAGES = [path for path in sorted(DOCS.rglob('*.rst'))
         if not {'generated', 'api', 'results', '_build'} & set(path.parts)
         and path.name != 'changes.rst']
# Things do not think, nobody hides, and sentences end with no riddle.
_THINGS = r'(star|table|file|PSF|fit|field|grid|tile|catalogue)s?'
PHRASES = re.compile(
    rf'\b{_THINGS} (know|feel|want|think|notice|believe|tell)s?\b'
    r'|\b(is|are|was|were) (said|thought|told)\b|\bwill do\b|\bwhoever\b'
    r'|\bwhat is left\b|\bbeside what\b|\bso many as\b|\bno matter of\b')


def prose(page):
    """Return the paragraphs of a page, without code, tables and examples."""
    blocks = re.split(r'\n\s*\n', page.read_text())
    return [' '.join(block.split()) for block in blocks if not re.search(
        r'^\s*(>>>|\.\.\s|\* - |[=\-~^+|]{3})', block, re.MULTILINE)]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.stem)
def test_pages_begin_with_a_sentence_and_have_no_riddles(page):
    paragraphs = prose(page)
    assert re.match(r'[^*#].*[.:]$', paragraphs[0]), paragraphs[0]
    for paragraph in paragraphs:
        found = PHRASES.search(paragraph)
        assert not found, f'{found.group()!r} in {paragraph!r}'
