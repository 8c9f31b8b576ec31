"""docs/faults.md has a complete row for every test of a fault, and a test for every fault."""

import faults as fault_table


def test_every_row_is_complete_and_every_fault_has_one():
    tests = fault_table.fault_tests()
    incomplete = [test for test in tests if "" in test]
    assert incomplete == [], "docstring: 'driver: ...; user reads: ...'"
    assert {test.fault for test in tests} == set(fault_table.FAULTS)


def test_the_page_is_up_to_date():
    page = fault_table.PAGE.read_text(encoding="utf-8")
    assert page == fault_table.page(), "run: make faults"
