"""docs/faults.md has every test of a fault."""

import fault_table


def test_every_fault_test_says_what_the_driver_does_and_what_the_user_reads():
    incomplete = [
        test.name for test in fault_table.fault_tests() if not (test.driver and test.user)
    ]
    assert incomplete == [], "docstring: 'driver: ...; user reads: ...'"


def test_every_fault_has_a_test():
    assert {test.fault for test in fault_table.fault_tests()} == set(fault_table.FAULTS)


def test_the_page_is_up_to_date():
    page = fault_table.PAGE.read_text(encoding="utf-8")
    assert page == fault_table.page(), "run: make faults"
