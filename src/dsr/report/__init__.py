"""Tables, figures and pages of results: of runs, of the user study, of surfaces."""
