"""What sdfhub raises when the fault lies outside its code: a message a user can act on."""


class SdfhubError(Exception):
    """A user's mistake or bad input, in one line: the file or key, what is wrong, what to do.

    The command line prints it without a traceback and exits with status 2.
    """


class RejectedMesh(SdfhubError):
    """A mesh from which no trustworthy signed distances can be made.

    Its `reason` is the short name of the rule that refused it, such as `non_finite_vertices`, by which
    summaries count; its `detail` says what was measured and what is the limit.
    """

    def __init__(self, reason: str, detail: str):
        super().__init__(f"{reason}: {detail}")
        self.reason, self.detail = reason, detail

    def __reduce__(self):  # an exception with two arguments must say how it crosses processes
        return type(self), (self.reason, self.detail)
