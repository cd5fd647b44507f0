"""
Results on their way into files, kept until a command has come to its end.

With ``--checkpoint FOLDER`` each result is written there first, under a name
that stands for all it depends on, and copied to where it belongs. The same
command, given again, finds what it had finished.
"""
import filecmp
import shutil
from functools import partial
from pathlib import Path

from photutils_mgauss.cli import tools


def add_checkpoint(parser):
    """Add the option for the folder."""
    parser.add_argument('--checkpoint', metavar='FOLDER',
                        help='keep finished results in a folder; if the '
                             'command is stopped, give it again to continue')


def add_dry_run(parser):
    """Add the option for checking everything and making nothing."""
    parser.add_argument('--dry-run', action='store_true',
                        help='check options and files, say what would be '
                             'written, and stop')


class Results:
    """
    The results of one command.

    Parameters
    ----------
    options : `argparse.Namespace`
        Those of the command.
    """

    def __init__(self, options):
        self._options = options
        self._files = []
        self._claimed = []
        self.folder = options.checkpoint and Path(options.checkpoint)
        if self.folder and self.folder.exists() and not self.folder.is_dir():
            msg = f'{self.folder}: --checkpoint must be a folder, not a file'
            raise NotADirectoryError(msg)

    def claim(self, names, inputs):
        """Raise unless the files can be written; see `tools.claim`."""
        new = [name for name in names if not self._is_ours(name)]
        tools.claim(new, self._options.overwrite, inputs)
        self._claimed = list(names)
        if self.folder:
            tools.check_folder(self.folder)

    def only_planned(self, names=None):
        """
        Say what would be written and return True in a dry run.

        ``names`` are those of the files, if fewer than were claimed.
        """
        if self._options.dry_run:
            tools.say(self._options, *(
                f'would write {name}' for name in names or self._claimed))
        return self._options.dry_run

    def _is_ours(self, name):
        """Whether a file was copied from the folder, by an earlier run."""
        if not self.folder or not name.is_file():
            return False
        size = name.stat().st_size
        return any(file.stat().st_size == size
                   and filecmp.cmp(name, file, shallow=False)
                   for file in self.folder.glob(f'[!.]*{name.suffix}'))

    def key(self, *things):
        """Return what stands for the command and what it is to work on."""
        if not self.folder:
            return ''
        from photutils_mgauss.utils.checkpoint import digest_of
        used = {name: value for name, value in vars(self._options).items()
                if name not in (*tools.NOT_STORED, 'inputs', 'checkpoint')}
        return digest_of(used, *things)

    def obtain(self, name, key, make, read=None):
        """
        Return a result, and have it put where it belongs by `deliver`.

        Parameters
        ----------
        name : `~pathlib.Path`
            Where it belongs.
        key : str
            See `key`.
        make : callable
            Called without arguments unless the result is kept. It returns
            the result, and a function that writes it to a name.
        read : callable, optional
            Reads the result from the file in which it is kept.
        """
        if not self.folder:
            result, write = make()
            self._files.append((name, write))
            return result
        kept = self.folder / f'{key}{name.suffix}'
        if not kept.exists():
            _, write = make()
            with tools.whole_file(kept) as draft:
                write(draft)
        self._files.append((name, partial(shutil.copyfile, kept)))
        return read and read(kept)

    def deliver(self):
        """Write all results that were obtained into their files."""
        for name, write in self._files:
            with tools.whole_file(name) as draft:
                write(draft)
        self._files.clear()


def file_marks(*paths):
    """Return what changes when files do: their names, sizes and times."""
    marks = []
    for path in filter(None, paths):
        stat = Path(path).stat()
        marks.append((str(Path(path).resolve()), stat.st_size,
                      stat.st_mtime_ns))
    return marks
