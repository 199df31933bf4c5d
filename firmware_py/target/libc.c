/* What gcc calls for structures and arrays, where there is no C library; clang brings its own. */
#include <stddef.h>

void *memcpy(void *to, const void *from, size_t size);
void *memset(void *to, int value, size_t size);

void *memcpy(void *to, const void *from, size_t size)
{
    volatile unsigned char *out = to; /* volatile: or it would be compiled to a call of itself */
    const unsigned char *in = from;
    for (size_t n = 0; n < size; n++) {
        out[n] = in[n];
    }
    return to;
}

void *memset(void *to, int value, size_t size)
{
    volatile unsigned char *out = to;
    for (size_t n = 0; n < size; n++) {
        out[n] = (unsigned char)value;
    }
    return to;
}
