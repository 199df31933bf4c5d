/* Runs the exported kernel: int32 words in, int32 words out, segment by segment.
 *
 * In: number of steps, control law, calibration, then setpoint and position for each step.
 * Out: state and io after each step.
 */
#include <stdio.h>

#include "ddh_controller.h"

static int read_words(int32_t *words, size_t count)
{
    return fread(words, sizeof *words, count, stdin) == count;
}

int main(void)
{
    int32_t head[2];
    int32_t calibration[DDH_CAL_SIZE];
    int32_t input[2];
    while (read_words(head, 2) && read_words(calibration, DDH_CAL_SIZE)) {
        int32_t state[DDH_ST_SIZE] = {0};
        int32_t io[DDH_IO_SIZE] = {0};
        for (int32_t step = 0; step < head[0]; step++) {
            if (!read_words(input, 2)) {
                return 1;
            }
            io[DDH_IO_POSITION] = input[1];
            if (step == 0) {
                io[DDH_IO_LAW] = head[1];
                ddh_control_reset(calibration, state, io);
            }
            io[DDH_IO_SETPOINT] = input[0];
            ddh_control_step(calibration, state, io);
            (void)fwrite(state, sizeof *state, DDH_ST_SIZE, stdout);
            (void)fwrite(io, sizeof *io, DDH_IO_SIZE, stdout);
        }
    }
    return 0;
}
