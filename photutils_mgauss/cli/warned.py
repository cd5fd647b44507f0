"""
Warnings of a command, each kind only once for each file.

Two warnings are of one kind if their first sentences differ in numbers only:
what is measured again and again is warned of each time, with other numbers.
"""
import re

from photutils_mgauss.cli import tools

_NUMBER = re.compile(r'[-+(\[]*\d+(?:\.\d+)?(?:e[-+]?\d+)?[%)\],.;:]*')


def kind_of(words):
    """Return the first sentence of a warning without its numbers."""
    first = words.partition('. ')[0].rstrip('.')
    return ' '.join('#' if _NUMBER.fullmatch(word) else word
                    for word in first.split())


class Warned:
    """
    What a command warned of.

    Parameters
    ----------
    warn : callable
        Shows words.
    note : callable
        Keeps the words that are not shown.
    """

    def __init__(self, warn, note):
        self._warn, self._note = warn, note
        self._known = {}
        self.left_out = 0

    def show(self, message, *_, **__):
        """Show a warning, unless one of its kind was shown for the file."""
        words, file = tools.one_line(str(message)), tools.subject()
        key = file, kind_of(words)
        if file is not None and file not in words:
            words = f'{file}: {words}'
        if key not in self._known:
            self._known[key] = {words}
            self._warn(words)
        elif words not in self._known[key]:
            self._known[key].add(words)
            self.left_out += 1
            self._note(words)

    def end(self):
        """Say how many warnings were left out, if any were."""
        if self.left_out:
            more = 'warnings' if self.left_out > 1 else 'warning'
            self._warn(f'{self.left_out} more {more} like these, with other '
                       'numbers, not shown; --log-file keeps them')
