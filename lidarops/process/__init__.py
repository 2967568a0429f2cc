"""Process one scene: open its files, carry out its plan, build its products, write them."""
