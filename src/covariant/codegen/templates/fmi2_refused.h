/* Functions of FMI 2.0 that a unit must offer and this one refuses. */
#include <stddef.h>
#include <stdint.h>

int fmi2SetInteger(void *, const uint32_t *, size_t, const int *);
int fmi2GetBoolean(void *, const uint32_t *, size_t, int *);
int fmi2SetBoolean(void *, const uint32_t *, size_t, const int *);
int fmi2GetString(void *, const uint32_t *, size_t, const char **);
int fmi2SetString(void *, const uint32_t *, size_t, const char *const *);
int fmi2GetDirectionalDerivative(void *, const uint32_t *, size_t, const uint32_t *, size_t, const double *, double *);
int fmi2SetRealInputDerivatives(void *, const uint32_t *, size_t, const int *, const double *);
int fmi2GetRealOutputDerivatives(void *, const uint32_t *, size_t, const int *, double *);
int fmi2CancelStep(void *);
int fmi2GetStatus(void *, int, int *);
int fmi2GetRealStatus(void *, int, double *);
int fmi2GetIntegerStatus(void *, int, int *);
int fmi2GetBooleanStatus(void *, int, int *);
int fmi2GetStringStatus(void *, int, const char **);
