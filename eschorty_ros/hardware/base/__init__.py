"""The three device protocols, USB access and the measure of stalls."""
