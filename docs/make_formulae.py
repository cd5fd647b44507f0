"""
Formulae as MathML, which browsers draw without a script or a network.

A command that the converter does not know would be printed as it stands, so
it is a warning here, and an error in the build that checks the pages.
"""
import re

UNKNOWN = re.compile(r'<m\w>(\\[a-zA-Z]+)</m\w>')


def as_mathml(node, display):
    """Return the MathML of a formula of a page."""
    # What only the pages need is imported where they are made.
    from latex2mathml.converter import convert
    from sphinx.util import logging

    text = ' '.join(node.astext().split())
    mathml = convert(text, display=display)
    for command in UNKNOWN.findall(mathml):
        logging.getLogger(__name__).warning(
            'unknown command %s in the formula %s', command, text,
            location=node)
    return mathml


def visit_inline(self, node):
    """Write a formula within a line."""
    from docutils.nodes import SkipNode

    self.body.append(as_mathml(node, 'inline'))
    raise SkipNode


def visit_block(self, node):
    """Write a formula of its own."""
    from docutils.nodes import SkipNode

    self.body += [self.starttag(node, 'div', CLASS='math'),
                  as_mathml(node, 'block'), '</div>\n']
    raise SkipNode


def setup(app):
    """Tell Sphinx."""
    app.add_html_math_renderer('mathml', (visit_inline, None),
                               (visit_block, None))
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
