/* A driver as a co-simulation unit of FMI 3.0 (https://fmi-standard.org/docs/3.0.2/).

   driver.h, made from the driver's ONNX graph, has the step of one driver: DT, SIGNALS, NOISE,
   TOKEN, `struct remembered` and `driver_step`. Here are the functions that FMI asks for, what a
   unit remembers, and steps of other lengths than the driver's.

   Value references: 0 is the time, 1 to SIGNALS are the inputs, then next_speed and acceleration,
   then the seed of a driver who leaves something to chance. */

#include <math.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#include "driver.h"

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } status; /* fmi3Status */
typedef void (*log_message)(void *environment, status status, const char *category, const char *message);

enum { TIME = 0, NEXT_SPEED = SIGNALS + 1, ACCELERATION, SEED };
/* Among the inputs: the first five signals of every driver. */
enum { EGO_SPEED = 1, EGO_ACCELERATION, LEADER_SPEED, LEADER_ACCELERATION, GAP };

#define SHORTEST 1e-9 /* s: what is left of a step below it is rounding */

/* All that changes while a unit is simulated, so that a state is a copy of it. */
struct state {
    double value[ACCELERATION + 1];
    int32_t seed;
    uint64_t random;
    double due;  /* s until the driver decides again */
    double held; /* m/s2: what it has decided */
    struct remembered remembered;
};

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

static void begin(struct unit *unit) {
    memset(&unit->state, 0, sizeof unit->state);
    unit->state.value[EGO_SPEED] = unit->state.value[LEADER_SPEED] = 10.0;
    unit->state.value[GAP] = 30.0;
    unit->state.value[NEXT_SPEED] = unit->state.value[EGO_SPEED];
}

/* SplitMix64 (Steele, Lea and Flood 2014, Fast splittable pseudorandom number generators). */
static uint64_t random_bits(uint64_t *random) {
    uint64_t bits = (*random += 0x9E3779B97F4A7C15u);
    bits = (bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9u;
    bits = (bits ^ (bits >> 27)) * 0x94D049BB133111EBu;
    return bits ^ (bits >> 31);
}

/* A standard normal number (Box and Muller 1958). */
static double normal(uint64_t *random) {
    double first = (double)((random_bits(random) >> 11) + 1) * 0x1.0p-53; /* (0, 1] */
    double second = (double)(random_bits(random) >> 11) * 0x1.0p-53;
    return sqrt(-2.0 * log(first)) * cos(6.283185307179586 * second);
}

/* Lets the driver decide; NaN where an input is not a number. */
static double decide(struct state *state, const double signal[SIGNALS]) {
    struct remembered after;
    double noise[NOISE + 1], speed;
    uint64_t random = state->random;
    for (int k = 0; k < NOISE; k++) noise[k] = normal(&random);
    driver_step(signal, &state->remembered, noise, &speed, &after);
    if (isnan(speed)) return NAN;
    state->random = random;
    state->remembered = after;
    return speed;
}

/* Simulates a communication step of any length. The driver decides every DT and holds its
   acceleration in between. Within a step that is longer, the vehicle ahead keeps the acceleration
   that it has at the begin. */
static status advance(struct unit *unit, double length) {
    struct state next = unit->state;
    double signal[SIGNALS], left = length;
    memcpy(signal, next.value + 1, sizeof signal);
    double *speed = &signal[EGO_SPEED - 1], *ahead = &signal[LEADER_SPEED - 1];
    double *gap = &signal[GAP - 1];
    while (left > SHORTEST) {
        if (next.due <= SHORTEST) {
            double decided = decide(&next, signal);
            if (isnan(decided)) return DISCARD;
            next.held = (decided - *speed) / DT;
            next.due = DT;
        }
        double part = fmin(next.due, left);
        /* The models integrate by forward Euler: vehicles move by their new speeds. */
        *speed = fmax(0.0, *speed + next.held * part);
        *ahead = fmax(0.0, *ahead + signal[LEADER_ACCELERATION - 1] * part);
        *gap += (*ahead - *speed) * part;
        signal[EGO_ACCELERATION - 1] = next.held;
        next.due -= part;
        left -= part;
    }
    next.value[NEXT_SPEED] = *speed;
    next.value[ACCELERATION] = (*speed - next.value[EGO_SPEED]) / length;
    unit->state = next;
    return OK;
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
    begin(unit);
    return unit;
}

EXPORT void fmi3FreeInstance(void *instance) { free(instance); }

EXPORT status fmi3EnterInitializationMode(
    void *instance, bool has_tolerance, double tolerance, double start, bool has_stop, double stop) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((struct unit *)instance)->state.value[TIME] = start;
    return OK;
}

/* Begins a driver; until the first step the speed stays. */
EXPORT status fmi3ExitInitializationMode(void *instance) {
    struct state *state = &((struct unit *)instance)->state;
    state->random = (uint64_t)(uint32_t)state->seed;
    state->value[NEXT_SPEED] = state->value[EGO_SPEED];
    return OK;
}

EXPORT status fmi3Terminate(void *instance) {
    (void)instance;
    return OK;
}

EXPORT status fmi3Reset(void *instance) {
    begin(instance);
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
    if (advance(unit, length) != OK) {
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
