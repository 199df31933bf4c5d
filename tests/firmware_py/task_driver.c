/* Runs the exported firmware: events in, what each period sends and leaves behind out; 64-bit words.
 *
 * In, four words each: 0 power-on, 1 frame (identifier, length, data), 2 timer.
 * Out, for each timer: number of frames, three times (identifier, length, data), all words of the controller.
 */
#include <stdio.h>
#include <string.h>

#include "ddh_controller.h"

enum { WORDS = sizeof(ddh_controller) / sizeof(int32_t) };

int main(void)
{
    static ddh_controller controller;
    int64_t event[4];
    memset(&controller, 0x5A, sizeof controller); /* what power-on finds is not zero */
    while (fread(event, sizeof event, 1, stdin) == 1) {
        if (event[0] == 0) {
            ddh_start(&controller);
        } else if (event[0] == 1) {
            ddh_receive(&controller, (uint32_t)event[1], (uint8_t)event[2], (uint64_t)event[3]);
        } else {
            int64_t out[10 + WORDS] = {0};
            int32_t words[WORDS];
            ddh_frame frames[DDH_MAX_FRAMES];
            out[0] = ddh_period(&controller, frames);
            for (int32_t i = 0; i < out[0]; i++) {
                out[1 + (3 * i)] = (int64_t)frames[i].can_id;
                out[2 + (3 * i)] = (int64_t)frames[i].length;
                out[3 + (3 * i)] = (int64_t)frames[i].data;
            }
            memcpy(words, &controller, sizeof words);
            for (int32_t i = 0; i < WORDS; i++) {
                out[10 + i] = words[i];
            }
            (void)fwrite(out, sizeof out, 1, stdout);
        }
    }
    return 0;
}
