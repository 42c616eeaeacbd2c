/* Functions of FMI 3.0 that a unit must offer and this one refuses. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void *fmi3InstantiateModelExchange(const char *, const char *, const char *, bool, bool, void *, void *);
void *fmi3InstantiateScheduledExecution(const char *, const char *, const char *, bool, bool, void *, void *, void *,
    void *, void *);
int fmi3GetFloat32(void *, const uint32_t *, size_t, const float *, size_t);
int fmi3GetInt8(void *, const uint32_t *, size_t, const int8_t *, size_t);
int fmi3GetUInt8(void *, const uint32_t *, size_t, const uint8_t *, size_t);
int fmi3GetInt16(void *, const uint32_t *, size_t, const int16_t *, size_t);
int fmi3GetUInt16(void *, const uint32_t *, size_t, const uint16_t *, size_t);
int fmi3GetUInt32(void *, const uint32_t *, size_t, const uint32_t *, size_t);
int fmi3GetInt64(void *, const uint32_t *, size_t, const int64_t *, size_t);
int fmi3GetUInt64(void *, const uint32_t *, size_t, const uint64_t *, size_t);
int fmi3GetBoolean(void *, const uint32_t *, size_t, const bool *, size_t);
int fmi3GetString(void *, const uint32_t *, size_t, const char **, size_t);
int fmi3SetFloat32(void *, const uint32_t *, size_t, const float *, size_t);
int fmi3SetInt8(void *, const uint32_t *, size_t, const int8_t *, size_t);
int fmi3SetUInt8(void *, const uint32_t *, size_t, const uint8_t *, size_t);
int fmi3SetInt16(void *, const uint32_t *, size_t, const int16_t *, size_t);
int fmi3SetUInt16(void *, const uint32_t *, size_t, const uint16_t *, size_t);
int fmi3SetUInt32(void *, const uint32_t *, size_t, const uint32_t *, size_t);
int fmi3SetInt64(void *, const uint32_t *, size_t, const int64_t *, size_t);
int fmi3SetUInt64(void *, const uint32_t *, size_t, const uint64_t *, size_t);
int fmi3SetBoolean(void *, const uint32_t *, size_t, const bool *, size_t);
int fmi3SetString(void *, const uint32_t *, size_t, const char **, size_t);
int fmi3SetInt32(void *, const uint32_t *, size_t, const int32_t *, size_t);
int fmi3GetBinary(void *, const uint32_t *, size_t, size_t *, const uint8_t **, size_t);
int fmi3SetBinary(void *, const uint32_t *, size_t, const size_t *, const uint8_t *const *, size_t);
int fmi3GetClock(void *, const uint32_t *, size_t, bool *);
int fmi3SetClock(void *, const uint32_t *, size_t, const bool *);
int fmi3GetNumberOfVariableDependencies(void *, uint32_t, size_t *);
int fmi3GetVariableDependencies(void *, uint32_t, size_t *, uint32_t *, size_t *, int *, size_t);
int fmi3GetDirectionalDerivative(void *, const uint32_t *, size_t, const uint32_t *, size_t, const double *, size_t, double *, size_t);
int fmi3GetAdjointDerivative(void *, const uint32_t *, size_t, const uint32_t *, size_t, const double *, size_t, double *, size_t);
int fmi3EnterConfigurationMode(void *);
int fmi3ExitConfigurationMode(void *);
int fmi3EnterEventMode(void *);
int fmi3GetIntervalDecimal(void *, const uint32_t *, size_t, double *, int *);
int fmi3GetIntervalFraction(void *, const uint32_t *, size_t, uint64_t *, uint64_t *, int *);
int fmi3GetShiftDecimal(void *, const uint32_t *, size_t, double *);
int fmi3GetShiftFraction(void *, const uint32_t *, size_t, uint64_t *, uint64_t *);
int fmi3SetIntervalDecimal(void *, const uint32_t *, size_t, const double *);
int fmi3SetIntervalFraction(void *, const uint32_t *, size_t, const uint64_t *, const uint64_t *);
int fmi3SetShiftDecimal(void *, const uint32_t *, size_t, const double *);
int fmi3SetShiftFraction(void *, const uint32_t *, size_t, const uint64_t *, const uint64_t *);
int fmi3EvaluateDiscreteStates(void *);
int fmi3UpdateDiscreteStates(void *, bool *, bool *, bool *, bool *, bool *, double *);
int fmi3GetOutputDerivatives(void *, const uint32_t *, size_t, const int32_t *, double *, size_t);
int fmi3EnterContinuousTimeMode(void *);
int fmi3CompletedIntegratorStep(void *, bool, bool *, bool *);
int fmi3SetTime(void *, double);
int fmi3SetContinuousStates(void *, const double *, size_t);
int fmi3GetContinuousStateDerivatives(void *, double *, size_t);
int fmi3GetEventIndicators(void *, double *, size_t);
int fmi3GetContinuousStates(void *, double *, size_t);
int fmi3GetNominalsOfContinuousStates(void *, double *, size_t);
int fmi3GetNumberOfEventIndicators(void *, size_t *);
int fmi3GetNumberOfContinuousStates(void *, size_t *);
int fmi3ActivateModelPartition(void *, uint32_t, double);
