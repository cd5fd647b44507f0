"""
What every other room uses and what knows none of them.

Arguments are checked here (`validation`), pixels and star tables are read
here, whatever form a user gives them (`image`, `star_columns`), work is
spread over threads or a cluster (`parallel`), and what depends on the version
of photutils stands in one place (`compat`). Nothing here is public: users
meet it as the error messages and the accepted inputs of all public calls.
A check that two calls share belongs here; anything that knows what a PSF, a
star or the sky is does not.
"""
