"""docs/faults.md tells of every fault, every test of one, and every fault a plan can name."""

import fault_table


def test_every_fault_test_says_what_the_driver_does_and_what_the_user_reads():
    silent = [test.name for test in fault_table.fault_tests() if not (test.driver and test.user)]
    assert silent == [], "docstring: 'driver: ...; user reads: ...'"


def test_the_page_has_a_row_for_every_fault_test():
    page = fault_table.PAGE.read_text(encoding="utf-8")
    rows = [row for row, _ in fault_table.result_rows(fault_table.fault_tests())]
    assert [row for row in rows if row not in page] == [], "run: make faults"


def test_the_page_has_the_catalogue():
    page = fault_table.PAGE.read_text(encoding="utf-8")
    assert fault_table.catalogue_table() in page, "run: make faults"
