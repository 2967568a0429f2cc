"""A static website of the products of a campaign. It needs neither server nor network."""
