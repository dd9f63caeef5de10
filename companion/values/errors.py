"""The base class of every error that a user can cause."""


class UserError(ValueError):
    """A mistake made by the user of the program.

    Its message is one line, and only that line is shown.

    Any other exception is a defect of the program and is shown with its traceback.
    """
