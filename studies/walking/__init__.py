"""Laws of people that the field uses: trained on some runs of two-way flows, tested on others."""
