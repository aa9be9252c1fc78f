"""An arm as it is, from recordings of it."""

from approxjac.calibration.calibrate import Calibration as Calibration
from approxjac.calibration.calibrate import PlaceSpread as PlaceSpread
from approxjac.calibration.calibrate import calibrate as calibrate
from approxjac.calibration.calibrate import next_configurations as next_configurations
from approxjac.calibration.fit import TipAccuracy as TipAccuracy
from approxjac.calibration.recording import Recording as Recording
