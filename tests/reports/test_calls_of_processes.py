"""Measurements in processes of their own."""

import os

from calls import one_line

from scripts.reports.timing import called


def test_a_function_is_called_in_a_process_of_its_own():
    assert called(os.getenv, "OWN", OWN="yes") == "yes"
    with one_line("ZeroDivisionError"):
        called(divmod, 1, 0)
