// SPDX-License-Identifier: BSD-3-Clause
// The calls of rosapi that roslib wraps. See run.mjs.

// The answers to some methods of Ros: [[method, ...arguments], …]; a failure is {failed: reason}.
export async function ask(page, { questions }) {
  const ros = await page.connect();
  return Promise.all(questions.map(([method, ...values]) => new Promise((resolve) => {
    // 1.x spreads getNodeDetails over three arguments when there is a second callback.
    const answer = (first, ...more) => resolve(more.length ? [first, ...more] : first);
    ros[method](...values, answer, (reason) => resolve({ failed: reason }));
  })));
}

// A message's fields, as roslib unfolds them.
export async function decode(page, { types }) {
  const ros = await page.connect();
  return Promise.all(types.map(async (type) => {
    const definitions = await new Promise((resolve, reject) => ros.getMessageDetails(type, resolve, reject));
    return ros.decodeTypeDefs(definitions);
  }));
}
