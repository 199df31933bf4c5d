/* The control kernel over inputs in memory, step by step, for comparison with its other machines. */
#include "ddh_controller.h"

typedef struct segment {
    int32_t steps;
    int32_t law;
    const int32_t *calibration;
    const int32_t *inputs; /* of each step: setpoint, position */
    int32_t *outputs; /* after each step: state, io */
} segment;

void run_segment(const segment *played);

void run_segment(const segment *played)
{
    int32_t state[DDH_ST_SIZE];
    int32_t io[DDH_IO_SIZE];
    const int32_t *input = played->inputs;
    int32_t *output = played->outputs;
    for (int32_t n = 0; n < DDH_ST_SIZE; n++) {
        state[n] = 0;
    }
    io[DDH_IO_LAW] = played->law;
    io[DDH_IO_POSITION] = input[1];
    ddh_control_reset(played->calibration, state, io);
    for (int32_t step = 0; step < played->steps; step++) {
        io[DDH_IO_SETPOINT] = *input++;
        io[DDH_IO_POSITION] = *input++;
        ddh_control_step(played->calibration, state, io);
        for (int32_t n = 0; n < DDH_ST_SIZE; n++) {
            *output++ = state[n];
        }
        for (int32_t n = 0; n < DDH_IO_SIZE; n++) {
            *output++ = io[n];
        }
    }
}
