"""Every reader of other people's files on damaged, foreign and malicious ones; ``make fuzz`` runs many cases."""
