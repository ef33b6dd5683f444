"""Super-resolution methods, one module each; ``conf/method`` and ``conf/model`` describe their options."""
