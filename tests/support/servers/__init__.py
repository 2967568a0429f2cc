"""Local servers of the tests: object store, scheduler, Prefect."""
