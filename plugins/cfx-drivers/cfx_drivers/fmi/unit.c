/* A driver as a co-simulation unit of FMI 3.0 (https://fmi-standard.org/docs/3.0.2/).

   driving.h has the driver. Here are the functions that FMI asks for.

   Value references: 0 is the time, 1 to SIGNALS are the inputs, then next_speed and acceleration,
   then the seed of a driver who leaves something to chance. */

#include <stdarg.h>

#include "driving.h"

typedef void (*log_message)(void *environment, status status, const char *category, const char *message);

enum { SEED = ACCELERATION + 1 };

struct unit {
    struct state state;
    log_message log;
    void *environment;
};

static void say(struct unit *unit, status status, const char *category, const char *format, ...) {
    char message[512];
    va_list values;
    if (!unit->log) return;
    va_start(values, format);
    vsnprintf(message, sizeof message, format, values);
    va_end(values);
    unit->log(unit->environment, status, category, message);
}

/* --- Instances ------------------------------------------------------------------------------- */

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT status fmi3SetDebugLogging(void *instance, bool on, size_t count, const char *const categories[]) {
    (void)instance, (void)on, (void)count, (void)categories;
    return OK;
}

EXPORT void *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool events, bool early, const uint32_t intermediate[], size_t intermediates,
    void *environment, log_message log, void *update) {
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)intermediate, (void)intermediates, (void)update;
    struct unit *unit = calloc(1, sizeof *unit);
    if (!unit) return NULL;
    unit->log = log;
    unit->environment = environment;
    if (!token || strcmp(token, TOKEN)) {
        say(unit, ERROR, "logStatusError", "the instantiation token is another unit's");
        free(unit);
        return NULL;
    }
    begin(&unit->state);
    return unit;
}

EXPORT void fmi3FreeInstance(void *instance) { free(instance); }

EXPORT status fmi3EnterInitializationMode(
    void *instance, bool has_tolerance, double tolerance, double start, bool has_stop, double stop) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((struct unit *)instance)->state.value[TIME] = start;
    return OK;
}

EXPORT status fmi3ExitInitializationMode(void *instance) {
    start(&((struct unit *)instance)->state);
    return OK;
}

EXPORT status fmi3Terminate(void *instance) {
    (void)instance;
    return OK;
}

EXPORT status fmi3Reset(void *instance) {
    begin(&((struct unit *)instance)->state);
    return OK;
}

/* --- Variables ------------------------------------------------------------------------------- */

EXPORT status fmi3GetFloat64(
    void *instance, const uint32_t references[], size_t count, double values[], size_t length) {
    struct unit *unit = instance;
    (void)length;
    for (size_t k = 0; k < count; k++) {
        if (references[k] > ACCELERATION) {
            say(unit, ERROR, "logStatusError", "there is no number with reference %u", references[k]);
            return ERROR;
        }
        values[k] = unit->state.value[references[k]];
    }
    return OK;
}

EXPORT status fmi3SetFloat64(
    void *instance, const uint32_t references[], size_t count, const double values[], size_t length) {
    struct unit *unit = instance;
    (void)length;
    for (size_t k = 0; k < count; k++) {
        if (references[k] == TIME || references[k] > SIGNALS) {
            say(unit, ERROR, "logStatusError", "reference %u is no input", references[k]);
            return ERROR;
        }
        unit->state.value[references[k]] = values[k];
    }
    return OK;
}

EXPORT status fmi3GetInt32(
    void *instance, const uint32_t references[], size_t count, int32_t values[], size_t length) {
    struct unit *unit = instance;
    (void)length;
    for (size_t k = 0; k < count; k++) {
        if (!NOISE || references[k] != SEED) return ERROR;
        values[k] = unit->state.seed;
    }
    return OK;
}

EXPORT status fmi3SetInt32(
    void *instance, const uint32_t references[], size_t count, const int32_t values[], size_t length) {
    struct unit *unit = instance;
    (void)length;
    for (size_t k = 0; k < count; k++) {
        if (!NOISE || references[k] != SEED) return ERROR;
        unit->state.seed = values[k];
    }
    return OK;
}

/* --- Steps ----------------------------------------------------------------------------------- */

EXPORT status fmi3DoStep(
    void *instance, double point, double length, bool no_set_before, bool *event, bool *terminate,
    bool *early, double *last) {
    struct unit *unit = instance;
    (void)no_set_before;
    *event = *terminate = *early = false;
    *last = point;
    if (!(length > SHORTEST)) {
        say(unit, ERROR, "logStatusError", "a step of %g s does not go on; give one above 0", length);
        return ERROR;
    }
    if (advance(&unit->state, length) != OK) {
        say(unit, DISCARD, "logStatusDiscard",
            "the step is discarded, as an input is not a number (ego_speed=%g, leader_speed=%g,"
            " gap=%g); set each of them, and gap to infinity where nobody is ahead",
            unit->state.value[EGO_SPEED], unit->state.value[LEADER_SPEED], unit->state.value[GAP]);
        return DISCARD;
    }
    *last = unit->state.value[TIME] = point + length;
    return OK;
}

/* --- States ---------------------------------------------------------------------------------- */

EXPORT status fmi3GetFMUState(void *instance, void **state) {
    if (!*state && !(*state = malloc(sizeof(struct state)))) return ERROR;
    memcpy(*state, &((struct unit *)instance)->state, sizeof(struct state));
    return OK;
}

EXPORT status fmi3SetFMUState(void *instance, void *state) {
    memcpy(&((struct unit *)instance)->state, state, sizeof(struct state));
    return OK;
}

EXPORT status fmi3FreeFMUState(void *instance, void **state) {
    (void)instance;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT status fmi3SerializedFMUStateSize(void *instance, void *state, size_t *size) {
    (void)instance, (void)state;
    *size = sizeof(struct state);
    return OK;
}

EXPORT status fmi3SerializeFMUState(void *instance, void *state, uint8_t bytes[], size_t size) {
    (void)instance;
    if (size < sizeof(struct state)) return ERROR;
    memcpy(bytes, state, sizeof(struct state));
    return OK;
}

EXPORT status fmi3DeserializeFMUState(void *instance, const uint8_t bytes[], size_t size, void **state) {
    (void)instance;
    if (size != sizeof(struct state)) return ERROR;
    if (!*state && !(*state = malloc(sizeof(struct state)))) return ERROR;
    memcpy(*state, bytes, sizeof(struct state));
    return OK;
}

/* --- What a unit of this kind has not, but must export ---------------------------------------- */

#define REFUSED(name) EXPORT status name() { return ERROR; }
#define NOT_THERE(name) EXPORT void *name() { return NULL; }

NOT_THERE(fmi3InstantiateModelExchange)
NOT_THERE(fmi3InstantiateScheduledExecution)
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3GetFloat32)
REFUSED(fmi3GetInt8)
REFUSED(fmi3GetUInt8)
REFUSED(fmi3GetInt16)
REFUSED(fmi3GetUInt16)
REFUSED(fmi3GetUInt32)
REFUSED(fmi3GetInt64)
REFUSED(fmi3GetUInt64)
REFUSED(fmi3GetBoolean)
REFUSED(fmi3GetString)
REFUSED(fmi3GetBinary)
REFUSED(fmi3GetClock)
REFUSED(fmi3SetFloat32)
REFUSED(fmi3SetInt8)
REFUSED(fmi3SetUInt8)
REFUSED(fmi3SetInt16)
REFUSED(fmi3SetUInt16)
REFUSED(fmi3SetUInt32)
REFUSED(fmi3SetInt64)
REFUSED(fmi3SetUInt64)
REFUSED(fmi3SetBoolean)
REFUSED(fmi3SetString)
REFUSED(fmi3SetBinary)
REFUSED(fmi3SetClock)
REFUSED(fmi3GetNumberOfVariableDependencies)
REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3GetDirectionalDerivative)
REFUSED(fmi3GetAdjointDerivative)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3GetIntervalDecimal)
REFUSED(fmi3GetIntervalFraction)
REFUSED(fmi3GetShiftDecimal)
REFUSED(fmi3GetShiftFraction)
REFUSED(fmi3SetIntervalDecimal)
REFUSED(fmi3SetIntervalFraction)
REFUSED(fmi3SetShiftDecimal)
REFUSED(fmi3SetShiftFraction)
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep)
REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators)
REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates)
REFUSED(fmi3EnterStepMode)
REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
