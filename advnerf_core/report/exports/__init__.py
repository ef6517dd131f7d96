"""An audit's result in the formats of other tools: OpenSCENARIO, SARIF and JUnit."""
